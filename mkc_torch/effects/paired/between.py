"""Signals at moments between their samples."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float, Int

__all__ = ["run_numbers", "shifted"]


def run_numbers(time: Float[Tensor, " N"]) -> Int[Tensor, " N"]:
    """Of each sample's run: where time goes back, a new one begins."""
    return torch.cat([torch.zeros(1, dtype=torch.long), (time.diff() < 0).long()]).cumsum(0)


def shifted(
    values: Float[Tensor, " N"], time: Float[Tensor, " N"], later: float | Float[Tensor, " N"]
) -> Float[Tensor, " N"]:
    """Values at moments that much later, along straight lines; beyond the ends of a run its last ones.

    Example:
        >>> time = torch.arange(5.0)
        >>> shifted(time**2, time, -0.5)
        tensor([ 0.0000,  0.5000,  2.5000,  6.5000, 12.5000])
    """
    run = run_numbers(time)
    least = time.min()
    span = time.max() - least + 1.0
    first = torch.searchsorted(run, run)
    last = torch.searchsorted(run, run, right=True) - 1
    at = (time - least + later).clamp(0.0, float(span) - 1.0)
    left = torch.searchsorted(run * span + time - least, run * span + at.detach(), right=True) - 1
    left = torch.minimum(torch.maximum(left, first), (last - 1).clamp(min=0))
    right = torch.minimum(left + 1, last)
    step = (time[right] - time[left]).clamp(min=1e-300)
    share = ((at - (time[left] - least)) / step).clamp(0.0, 1.0)
    return torch.lerp(values[left], values[right], share)
