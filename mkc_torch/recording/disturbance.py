"""Time intervals in which most samples are rejected."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_WINDOW_SECONDS = 0.25
"""Length of the window around a sample, in s."""

_JOIN_SECONDS = 1.0
"""Longest gap in s between two intervals that are joined."""

_FEWEST = 5
"""Fewest samples of a window."""


class RejectedInterval(NamedTuple):
    """Times of the first and the last rejected sample, in s."""

    start: float
    end: float


def disturbed_intervals(time: Float[Tensor, " N"], rejected: Bool[Tensor, " N"]) -> tuple[RejectedInterval, ...]:
    """Intervals in which at least half of the samples within a quarter of a second (at least 5) are rejected.

    Intervals less than a second apart are joined. Scattered rejected samples, as in heavy-tailed noise, belong to no
    interval. An interval ends where the time restarts, as between the runs of a table.

    Args:
        time: in s, ascending within each run.
        rejected: mask of the rejected samples.

    Example:
        >>> time = torch.arange(1000) / 50.0
        >>> disturbed_intervals(time, (time > 4.0) & (time < 7.0))
        (RejectedInterval(start=4.01..., end=6.98...),)
    """
    steps = time.diff()
    starts = torch.cat([torch.tensor([0]), (steps < 0).nonzero().squeeze(-1) + 1, torch.tensor([len(time)])])
    forward = steps[steps > 0]
    if len(forward) == 0:
        return ()
    half = int((0.5 * _WINDOW_SECONDS / forward.median()).round().clamp(_FEWEST // 2, 500))
    join = max(_JOIN_SECONDS, (2 * half + 1) * float(forward.median()))
    found: list[RejectedInterval] = []
    for begin, end in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        found += _in_one_run(time[begin:end], rejected[begin:end], half, join)
    return tuple(found)


def _in_one_run(time: Tensor, rejected: Tensor, half: int, join: float) -> list[RejectedInterval]:
    count = torch.cat([torch.zeros(1, dtype=torch.int64), rejected.long().cumsum(0)])
    index = torch.arange(len(time))
    low, high = (index - half).clamp(min=0), (index + half + 1).clamp(max=len(time))
    # windows at the ends count as full windows, so that a single sample there is not a disturbance
    dense = (count[high] - count[low]) >= half + 1
    hits = (dense & rejected).nonzero().squeeze(-1)
    found: list[RejectedInterval] = []
    for t in time[hits].tolist():
        if found and t - found[-1].end <= join:
            found[-1] = RejectedInterval(found[-1].start, t)
        else:
            found.append(RejectedInterval(t, t))
    return found
