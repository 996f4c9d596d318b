"""Run numbers of the samples of a recording."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float, Shaped

    from mkc_torch.recording.recording import Recording


def successive_runs(label: Shaped[Tensor, " N"], time: Float[Tensor, " N"]) -> Tensor:
    """Number of each sample's run, (N,), ascending; a run begins where the label changes or time goes back.

    Example:
        >>> successive_runs(torch.tensor([7, 7, 3, 3, 3]), torch.tensor([0.0, 1.0, 2.0, 3.0, 0.0]))
        tensor([0, 0, 1, 1, 2])
    """
    begins = (label.diff() != 0) | (time.diff() < 0)
    return torch.cat([torch.zeros(1, dtype=torch.long), begins.long()]).cumsum(0)


def experiment_runs(recording: Recording) -> Tensor:
    """Number of each sample's run, (N,), by the column ``experiment`` of a recording and its times."""
    time = recording["time"]
    return successive_runs(recording["experiment"] if "experiment" in recording else torch.zeros_like(time), time)
