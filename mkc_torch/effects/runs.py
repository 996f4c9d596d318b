"""Which run of a recording each sample is of, and what is passed on from sample to sample within a run."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

__all__ = ["first_of_runs", "passed_on", "passed_on_within", "run_numbers"]


def run_numbers(time: Float[Tensor, " N"]) -> Int[Tensor, " N"]:
    """Of each sample's run: where time goes back, a new one begins.

    Example:
        >>> run_numbers(torch.tensor([0.0, 1.0, 0.0, 1.0]))
        tensor([0, 0, 1, 1])
    """
    return torch.cat([torch.zeros(1, dtype=torch.long), (time.diff() < 0).long()]).cumsum(0)


def first_of_runs(run: Int[Tensor, " N"]) -> Bool[Tensor, " N"]:
    """Whether each sample is the first of its run."""
    return torch.cat([torch.ones(1, dtype=torch.bool), run.diff() != 0])


def passed_on(factor: Float[Tensor, " N"], level: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """``y[k] = factor[k] y[k-1] + level[k]``, from ``y[-1] = 0``: affine maps composed by doubling.

    A factor of 0 begins anew. Blelloch, "Prefix sums and their applications" (1990).

    Example:
        >>> passed_on(torch.tensor([0.0, 0.5, 0.5]), torch.tensor([4.0, 0.0, 1.0]))
        tensor([4., 2., 2.])
    """
    shift = 1
    while shift < len(level):
        tail_level = factor[shift:] * level[:-shift] + level[shift:]
        tail_factor = factor[shift:] * factor[:-shift]
        factor, level = torch.cat([factor[:shift], tail_factor]), torch.cat([level[:shift], tail_level])
        shift *= 2
    return level


def passed_on_within(low: Float[Tensor, " N"], high: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """``y[k] = max(low[k], min(high[k], y[k-1]))``: clamps are composed by doubling, for one after another is a clamp.

    Where ``low`` and ``high`` are one, as at the first sample they have to be, it begins anew.

    Example:
        >>> passed_on_within(torch.tensor([0.0, 1.0, 0.5, -2.0]), torch.tensor([0.0, 3.0, 2.5, 0.0]))
        tensor([0., 1., 1., 0.])
    """
    shift = 1
    while shift < len(low):
        least, most = low[shift:], high[shift:]
        tail_low = torch.maximum(least, torch.minimum(most, low[:-shift]))
        tail_high = torch.maximum(least, torch.minimum(most, high[:-shift]))
        low, high = torch.cat([low[:shift], tail_low]), torch.cat([high[:shift], tail_high])
        shift *= 2
    return low
