"""The loss by which a network learns that follows its residuals: the first one, and Welsch's of the bandwidth found."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch.density.energy import energy
from mkc_torch.losses._energy_sums import energy_sums
from mkc_torch.losses._first_loss import first_loss
from mkc_torch.losses._following import Followed, scale_of

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["Late", "late_of", "limited", "steered", "steered_each"]

_AS_GOOD_AS_NONE = 32.0
"""Bandwidth in scales from which it is no limit: half the widest that is tried."""


class Late(NamedTuple):
    """1/σ² and d, each (m,), of the energy that takes the place of the first loss."""

    kappa: Float[Tensor, " m"]
    d: Float[Tensor, " m"]


def late_of(state: Followed) -> Late:
    """That of the bandwidth found."""
    return Late(torch.exp(-2.0 * state.log_bandwidth), scale_of(state))


def limited(state: Followed, kappa: Float[Tensor, " m"], d: Float[Tensor, " m"]) -> Late:
    """That of a likelihood, but no wider than the bandwidth found."""
    widest = state.log_bandwidth.exp()
    least = torch.where(widest < _AS_GOOD_AS_NONE, (d / (widest * scale_of(state))).square(), 0.0)
    return Late(torch.maximum(kappa, least), d)


def steered(
    input: Float[Tensor, "*shape"],
    target: Float[Tensor, "*shape"] | None,
    weight: Tensor | None,
    axis: int,
    state: Followed,
    late: Late,
    *,
    turned: bool,
) -> Float[Tensor, " m"]:
    """The sums, of each channel, of the loss by which a network learns; its gradient is that of a likelihood in size.

    Args:
        input: predictions, or errors where there is no target.
        target: what the predictions should be.
        weight: of each element; None for 1.
        axis: of the channels.
        state: after this batch.
        late: what comes after the first loss.
        turned: whether the first loss has no part any more.
    """
    dtype = input.dtype
    scale = scale_of(state).to(dtype)
    after = energy_sums(input, late.kappa.to(dtype), late.d.to(dtype), weight, axis, target=target)
    if turned:
        return after
    error = input if target is None else input - target
    shape = [1] * error.dim()
    shape[axis] = -1
    early = first_loss(error / scale.view(shape))
    others = [i for i in range(error.dim()) if i != axis]
    early = early if weight is None else weight * early
    share = state.turned.to(dtype)
    return share * after + (1.0 - share) * (early.sum(others) if others else early)


def steered_each(error: Tensor, axis: int, state: Followed, late: Late) -> Tensor:
    """The same for each element, without weights."""
    shape = [1] * error.dim()
    shape[axis] = -1
    kappa, d, scale, share = (one.to(error.dtype).view(shape) for one in (*late, scale_of(state), state.turned))
    return share * energy(error / d, kappa) + (1.0 - share) * first_loss(error / scale)
