"""Split a recording into runs, and keep samples of different runs independent."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.recording.recording import Recording

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_EXPERIMENT = "experiment"

_FARTHEST = 1.1447 * 1078.0 ** (1.0 / 3.0)
"""Largest bandwidth of Andrews' rule over the cube root of the number of samples, at its largest correlation, 0.97."""


def run_slices(recording: Recording) -> tuple[slice, ...]:
    """The rows of each run: between two changes of ``experiment``, or all rows without that column.

    Example:
        >>> run_slices(Recording({"experiment": torch.tensor([1, 1, 2])}))
        (slice(0, 2, None), slice(2, 3, None))
    """
    if _EXPERIMENT not in recording:
        return (slice(0, len(recording)),)
    _, counts = torch.unique_consecutive(recording[_EXPERIMENT], return_counts=True)
    ends = counts.cumsum(0).tolist()
    return tuple(slice(begin, end) for begin, end in zip([0, *ends[:-1]], ends, strict=True))


def in_each_run(
    points: Float[Tensor, "N 3"], runs: tuple[slice, ...], function: Callable[[Tensor], Tensor | None]
) -> Tensor | None:
    """Apply a function of consecutive samples to each run and join the results; None if it returns None for any run."""
    found = [function(points[run]) for run in runs]
    return None if any(part is None for part in found) else torch.cat([part for part in found if part is not None])


def apart(
    runs: tuple[slice, ...], points: Float[Tensor, "N 3"], weight: Bool[Tensor, " N"]
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, " M"]]:
    """Insert samples of weight 0 between the runs, more than the largest bandwidth of a time series' standard errors.

    Standard errors of a time series sum the products of neighbouring samples; samples of different runs are not
    neighbours.

    Args:
        runs: from :func:`run_slices`.
        points: points in the order of time within each run.
        weight: mask of the points in use.

    Example:
        >>> points, weight = apart((slice(0, 2), slice(2, 5)), torch.ones(5, 3), torch.ones(5, dtype=torch.bool))
        >>> len(points) > 5, int(weight.sum()), weight[:3].tolist()
        (True, 5, [1.0, 1.0, 0.0])
    """
    taken = weight.to(points)
    if len(runs) == 1:
        return points, taken
    far = math.ceil(min(_FARTHEST * len(points) ** (1.0 / 3.0), len(points) / 4)) + 1
    parts, shares = [], []
    for run in runs:
        parts += [points[run], points[run][-1:].expand(far, 3)]
        shares += [taken[run], taken.new_zeros(far)]
    return torch.cat(parts[:-1]), torch.cat(shares[:-1])
