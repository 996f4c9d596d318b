"""Find runs of equal samples, and measure the changes, digital steps and noise to compare them with."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_AFTER = 5
"""Number of samples whose median is the next position of a sensor; two outliers do not change it."""

_ORDER = 4
"""Order of the differences from which noise is estimated."""

_WINDOW = 25
"""Differences in a window from which noise is estimated."""

_DIFFERENCED = 70.0**0.5
"""Factor from the standard deviation of white noise to that of its fourth differences: the root of the sum of squared
binomial coefficients. Smooth motion that the samples resolve has almost no fourth differences."""

_QUIETEST = 0.05
"""Quantile of the windows' noise that counts as the quietest."""


class Repeat(NamedTuple):
    """Equal rows ``start`` to ``end``, excluding ``end``."""

    start: int
    end: int


def repeats(values: Float[Tensor, "N k"], ends: list[int], least: int) -> list[Repeat]:
    """Find sequences of at least ``least`` equal rows; no sequence crosses the row numbers in ``ends``.

    Example:
        >>> repeats(torch.tensor([[1.0], [2.0], [2.0], [2.0], [3.0]]), [], 2)
        [Repeat(start=1, end=4)]
    """
    same = (values[1:] == values[:-1]).all(-1)
    same[[end - 1 for end in ends]] = False
    number = torch.cat([torch.zeros(1, dtype=torch.int64), (~same).cumsum(0)])
    counts = torch.bincount(number)
    last = counts.cumsum(0)
    return [Repeat(int(last[k] - counts[k]), int(last[k])) for k in (counts >= least).nonzero().flatten().tolist()]


def next_place(values: Float[Tensor, "N k"], row: int, end: int) -> Float[Tensor, " k"] | None:
    """The median position of the sensor after ``row`` and before ``end``, (k,); None with too few samples."""
    following = values[row : min(row + _AFTER, end)]
    return None if len(following) < _AFTER else following.median(0).values


def usual_move(values: Float[Tensor, "N k"], free: Bool[Tensor, " N"]) -> float:
    """99th percentile of a sensor's distance from a sample to the median of the next five.

    Args:
        values: columns of a sensor.
        free: mask of the rows from which it is estimated.
    """
    if len(values) <= _AFTER:
        return float("inf")
    ahead = values.unfold(0, _AFTER, 1).median(-1).values[1:]
    moved = torch.linalg.vector_norm(ahead - values[: len(ahead)], dim=-1)[free[: len(ahead)]]
    return float(torch.quantile(moved[: 10**7], 0.99)) if len(moved) > 0 else float("inf")


def step_of_digits(column: Float[Tensor, " N"]) -> float:
    """The smallest difference between two values; 0 if there is only a single value.

    Differences by rounding, as of scaled numbers, are ignored.
    """
    values = column.unique()
    steps = values.diff()
    real = steps[steps > 1e-9 * values.abs().max()]
    return float(real.min()) if len(real) > 0 else 0.0


def quietest_noise(column: Float[Tensor, " N"]) -> float:
    """Standard deviation of the noise in the quietest windows, by fourth differences; 0 with too few samples."""
    differences = column.diff(n=_ORDER)
    if len(differences) < _WINDOW:
        return 0.0
    size = differences.unfold(0, _WINDOW, max(1, _WINDOW // 2)).square().mean(-1).sqrt() / _DIFFERENCED
    return float(torch.quantile(size[: 10**7], _QUIETEST))
