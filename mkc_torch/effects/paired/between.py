"""Signals at moments between their samples."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.runs import run_numbers

if TYPE_CHECKING:
    from jaxtyping import Float, Int

__all__ = ["shifted"]


def shifted(
    values: Float[Tensor, " N"],
    time: Float[Tensor, " N"],
    later: float | Float[Tensor, " N"],
    run: Int[Tensor, " N"] | None = None,
) -> Float[Tensor, " N"]:
    """Values at moments that much later, along straight lines; beyond the ends of a run its last ones.

    Args:
        values: at the samples.
        time: of the samples in s, going on within each run.
        later: in s; negative for earlier.
        run: of each sample's run, in ascending order; None where a run begins when time goes back, and only there.

    Example:
        >>> time = torch.arange(5.0)
        >>> shifted(time**2, time, -0.5)
        tensor([ 0.0000,  0.5000,  2.5000,  6.5000, 12.5000])
    """
    run = run_numbers(time) if run is None else run
    least = time.min()
    span = time.max() - least + 1.0
    first = torch.searchsorted(run, run)
    last = torch.searchsorted(run, run, right=True) - 1
    at = (time - least + later).clamp(0.0, float(span) - 1.0)
    left = torch.searchsorted(run * span + time - least, run * span + at.detach(), right=True) - 1
    left = torch.minimum(torch.maximum(left, first), torch.maximum(last - 1, first))
    right = torch.minimum(left + 1, last)
    step = (time[right] - time[left]).clamp(min=1e-300)
    share = ((at - (time[left] - least)) / step).clamp(0.0, 1.0)
    return torch.lerp(values[left], values[right], share)
