"""A state_dict of a loss that learns read by one that does not, and the other way round."""

from __future__ import annotations

from collections.abc import MutableMapping
from typing import Any

import torch
from torch import Tensor

from mkc_torch.density.energy import KAPPA_MAX
from mkc_torch.losses._following import Following

__all__ = ["logit_of_kappa", "logit_of_scale", "ratio_of", "translate"]


def logit_of_kappa(kappa: Tensor) -> Tensor:
    # a hair inside the range, where the gradient is not 0
    return torch.logit((kappa.double() / KAPPA_MAX).clamp(max=1.0 - 1e-6)).to(kappa)


def logit_of_scale(d: Tensor, low: Tensor, high: Tensor) -> Tensor:
    return torch.logit((d.double() - low.double()) / (high.double() - low.double())).to(d)


def ratio_of(raw: Tensor) -> Tensor:
    """Times the scale of the residuals, within a factor of e²."""
    return torch.exp(2.0 * torch.tanh(0.5 * raw))


def translate(
    state: MutableMapping[str, Any], prefix: str, *, learns_kappa: bool, learns_d: bool, follows: bool
) -> None:
    """Change what is stored into what a loss has: σ and d as they are, learned or fixed, in place.

    A loss that takes d from the residuals needs their state; a fixed d does not become one.
    """

    def taken(name: str) -> Tensor | None:
        value = state.get(prefix + name)
        return value if isinstance(value, Tensor) else None

    raw, fixed = taken("raw_kappa"), taken("fixed_kappa")
    if learns_kappa and raw is None and fixed is not None and bool((fixed > 0).all()):
        state[prefix + "raw_kappa"] = logit_of_kappa(state.pop(prefix + "fixed_kappa"))
    if not learns_kappa and fixed is None and raw is not None:
        state[prefix + "fixed_kappa"] = KAPPA_MAX * torch.sigmoid(state.pop(prefix + "raw_kappa"))
    bound, floor = taken("bound"), taken("d_min")
    if follows or bound is None or floor is None:
        return
    raw, fixed, log_scale = taken("raw_d"), taken("fixed_d"), taken("following.log_scale")
    if log_scale is not None:
        scale = log_scale.exp() if raw is None else log_scale.exp() * ratio_of(raw)
        fixed, raw = torch.minimum(torch.maximum(scale, floor * (1.0 + 1e-6)), 0.5 * bound), None
        state.pop(prefix + "raw_d", None)
        for name, _ in Following(1).named_buffers():
            state.pop(f"{prefix}following.{name}", None)
        state[prefix + "fixed_d"] = fixed
    if learns_d and raw is None and fixed is not None:
        state[prefix + "raw_d"] = logit_of_scale(state.pop(prefix + "fixed_d"), floor, bound)
    if not learns_d and fixed is None and raw is not None:
        state[prefix + "fixed_d"] = floor + (bound - floor) * torch.sigmoid(state.pop(prefix + "raw_d"))
