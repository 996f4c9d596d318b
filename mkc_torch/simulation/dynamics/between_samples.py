"""Interpolation of inputs between the samples of a recording."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.simulation.ports import SignalTimes

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_POINTS = 6
"""Samples that the interpolating polynomial goes through."""


def inputs_between(
    values: Float[Tensor, "N u"], how: str, time: Float[Tensor, " N"], begins: Bool[Tensor, " N"], clock: SignalTimes
) -> Float[Tensor, "S u"]:
    """Interpolate inputs at the times of a clock.

    Args:
        values: (N, u), the inputs at the samples.
        how: "held" at the preceding sample, "linear", or "smooth"; see :func:`smooth_between`.
        time: (N,), times of the samples in s.
        begins: (N,), True where a run begins.
        clock: the S times to interpolate at.
    """
    if how == "held":
        return values[clock.before]
    return clock.at(values) if how == "linear" else smooth_between(values, time, begins, clock)


def smooth_between(
    values: Float[Tensor, "N u"], time: Float[Tensor, " N"], begins: Bool[Tensor, " N"], clock: SignalTimes
) -> Float[Tensor, "S u"]:
    """Interpolate inputs by the polynomial of fifth degree through the six nearest samples of the same run.

    Runs of fewer than six samples are interpolated linearly.

    Args:
        values: (N, u), the inputs at the samples.
        time: (N,), times of the samples in s.
        begins: (N,), True where a run begins.
        clock: the S times to interpolate at.

    Example:
        >>> time = torch.arange(0.0, 10.0, dtype=torch.float64)
        >>> clock = SignalTimes(time[:-1] + 0.5, torch.arange(9), torch.arange(1, 10), torch.full((9,), 0.5).double())
        >>> found = smooth_between(torch.sin(time).unsqueeze(-1), time, time == 0.0, clock)
        >>> bool((found[3:6, 0] - torch.sin(time[3:6] + 0.5)).abs().max() < 5e-3)
        True
    """
    first = begins.nonzero().squeeze(-1)
    last = torch.cat([first[1:], first.new_tensor([len(time)])]) - 1
    run = begins.long().cumsum(0)[clock.before] - 1
    start = torch.minimum(clock.before - _POINTS // 2 + 1, last[run] - _POINTS + 1)
    enough = last[run] - first[run] + 1 >= _POINTS
    start = torch.where(enough, torch.maximum(start, first[run]), 0)
    index = (start.unsqueeze(-1) + torch.arange(_POINTS)).clamp(max=len(time) - 1)
    at = time[index]
    away = clock.time.unsqueeze(-1) - at
    others = ~torch.eye(_POINTS, dtype=torch.bool)
    above = torch.where(others, away.unsqueeze(-2), 1.0).prod(-1)
    below = torch.where(others, at.unsqueeze(-1) - at.unsqueeze(-2), 1.0).prod(-1)
    weight = above / torch.where(enough.unsqueeze(-1), below, 1.0)
    smooth = torch.einsum("sk,sku->su", weight, values[index])
    return torch.where(enough.unsqueeze(-1), smooth, clock.at(values))
