"""Conversion of a state_dict between losses that learn σ and d and losses that do not."""

from __future__ import annotations

from collections.abc import MutableMapping
from typing import Any

import torch
from torch import Tensor

from mkc_torch.density.energy import KAPPA_MAX
from mkc_torch.losses._parameters import ChannelState, to_d
from mkc_torch.losses.residual_scale import ResidualScale


def logit_of_kappa(kappa: Tensor) -> Tensor:
    # slightly inside the range, where the gradient is not 0
    return torch.logit((kappa.double() / KAPPA_MAX).clamp(max=1.0 - 1e-6)).to(kappa)


def logit_of_scale(d: Tensor, low: Tensor, high: Tensor) -> Tensor:
    return torch.logit((d.double() - low.double()) / (high.double() - low.double())).to(d)


def translate(
    state: MutableMapping[str, Any], prefix: str, *, learns_kappa: bool, learns_d: bool, follows: bool, robust: bool
) -> None:
    """Convert a stored state in place: the same σ and d, learned or fixed as in the loss that loads it.

    Args:
        state: the state_dict to load.
        prefix: prefix of the loss's names.
        learns_kappa, learns_d: whether the loading loss learns σ and d.
        follows: whether its d follows the residuals.
        robust: whether it has a running scale and a schedule.
    """

    def stored(name: str) -> Tensor | None:
        value = state.get(prefix + name)
        return value if isinstance(value, Tensor) else None

    raw, fixed = stored("raw_kappa"), stored("fixed_kappa")
    if learns_kappa and raw is None and fixed is not None and (fixed.is_meta or bool((fixed > 0).all())):
        state[prefix + "raw_kappa"] = logit_of_kappa(state.pop(prefix + "fixed_kappa"))
    if not learns_kappa and fixed is None and raw is not None:
        state[prefix + "fixed_kappa"] = KAPPA_MAX * torch.sigmoid(state.pop(prefix + "raw_kappa"))
    if follows:
        return
    if stored("residual_scale.log_scale") is not None:
        # a loss with a given d stores both; a loss whose d follows the residuals takes them from its scale
        given = stored("fixed_bound") is not None and stored("fixed_d_min") is not None
        if stored("fixed_d") is None and not given:
            _freeze(state, prefix)
        if not robust:
            running = (f"{prefix}residual_scale.", f"{prefix}schedule.")
            for name in [entry for entry in state if entry.startswith(running)]:
                del state[name]
    raw, fixed, bound, floor = (stored(name) for name in ("raw_d", "fixed_d", "fixed_bound", "fixed_d_min"))
    if bound is None or floor is None:
        return
    if learns_d and raw is None and fixed is not None:
        state[prefix + "raw_d"] = logit_of_scale(state.pop(prefix + "fixed_d"), floor, bound)
    if not learns_d and fixed is None and raw is not None:
        state[prefix + "fixed_d"] = floor + (bound - floor) * torch.sigmoid(state.pop(prefix + "raw_d"))


def _freeze(state: MutableMapping[str, Any], prefix: str) -> None:
    """Add bound, floor and d that a running scale implies, in place."""
    like = state[prefix + "residual_scale.log_scale"]
    scale = ResidualScale(len(like)).to(like)
    scale.load_state_dict({name: state[f"{prefix}residual_scale.{name}"] for name in scale.state_dict()})
    bound = state.setdefault(prefix + "fixed_bound", scale.bound)
    floor = state.setdefault(prefix + "fixed_d_min", scale.floor)
    d = to_d(state.pop(prefix + "raw_d", None), ChannelState(bound, floor, scale.scale), follows=True)
    state[prefix + "fixed_d"] = torch.maximum(d, floor * (1.0 + 1e-6))
