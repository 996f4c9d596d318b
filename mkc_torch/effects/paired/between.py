"""Signals between their samples."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.runs import run_numbers

if TYPE_CHECKING:
    from jaxtyping import Float, Int


def shifted(
    values: Float[Tensor, " N"],
    time: Float[Tensor, " N"],
    later: float | Float[Tensor, " N"],
    run: Int[Tensor, " N"] | None = None,
) -> Float[Tensor, " N"]:
    """Values shifted in time by linear interpolation; beyond the ends of a run its first or last value.

    Args:
        values: values at the samples.
        time: times of the samples in s, ascending within each run.
        later: shift in s; negative for earlier moments.
        run: number of each sample's run, ascending; None: a run begins only where time goes back.

    Example:
        >>> time = torch.arange(5.0)
        >>> shifted(time**2, time, -0.5)
        tensor([ 0.0000,  0.5000,  2.5000,  6.5000, 12.5000])
    """
    run = run_numbers(time) if run is None else run
    start = time.min()
    span = time.max() - start + 1.0
    first = torch.searchsorted(run, run)
    last = torch.searchsorted(run, run, right=True) - 1
    at = (time - start + later).clamp(0.0, float(span) - 1.0)
    left = torch.searchsorted(run * span + time - start, run * span + at.detach(), right=True) - 1
    left = torch.minimum(torch.maximum(left, first), torch.maximum(last - 1, first))
    right = torch.minimum(left + 1, last)
    step = (time[right] - time[left]).clamp(min=1e-300)
    share = ((at - (time[left] - start)) / step).clamp(0.0, 1.0)
    return torch.lerp(values[left], values[right], share)
