"""Stretches in which a column holds one value: where they lie, and what a change after one is measured by."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["Repeat", "quietest_noise", "repeats", "step_of_digits", "usual_move"]

_AFTER = 5
"""Samples whose median is where a sensor is next: two that are disturbed do not move it."""

_ORDER, _WINDOW = 4, 25
_DIFFERENCED = 70.0**0.5
"""Root of the sum of squares of the binomial coefficients: what fourth differences make of independent noise. What
moves smoothly has next to none, at any speed at which the samples still follow it."""

_QUIETEST = 0.05


class Repeat(NamedTuple):
    """Rows ``start`` to ``end``, the latter not among them, that are equal."""

    start: int
    end: int


def repeats(values: Float[Tensor, "N k"], ends: list[int], least: int) -> list[Repeat]:
    """Runs of at least so many equal rows; none reaches over the row numbers in ``ends``.

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
    """Where the sensor is from a row on, before another row; None if there are too few samples to say."""
    following = values[row : min(row + _AFTER, end)]
    return None if len(following) < _AFTER else following.median(0).values


def usual_move(values: Float[Tensor, "N k"], free: Bool[Tensor, " N"]) -> float:
    """How far a sensor goes, at the most usually, from one sample to the middle of the next five.

    Args:
        values: columns of one sensor.
        free: rows to learn it from.
    """
    if len(values) <= _AFTER:
        return float("inf")
    ahead = values.unfold(0, _AFTER, 1).median(-1).values[1:]
    moved = torch.linalg.vector_norm(ahead - values[: len(ahead)], dim=-1)[free[: len(ahead)]]
    return float(torch.quantile(moved[: 10**7], 0.99)) if len(moved) > 0 else float("inf")


def step_of_digits(column: Float[Tensor, " N"]) -> float:
    """The least difference between two values; 0 where there is one value alone.

    Differences of rounding, which numbers that were multiplied have, are none.
    """
    values = column.unique()
    steps = values.diff()
    real = steps[steps > 1e-9 * values.abs().max()]
    return float(real.min()) if len(real) > 0 else 0.0


def quietest_noise(column: Float[Tensor, " N"]) -> float:
    """Standard deviation of the noise where it is least: of fourth differences in the quietest windows; 0 if few."""
    differences = column.diff(n=_ORDER)
    if len(differences) < _WINDOW:
        return 0.0
    size = differences.unfold(0, _WINDOW, max(1, _WINDOW // 2)).square().mean(-1).sqrt() / _DIFFERENCED
    return float(torch.quantile(size[: 10**7], _QUIETEST))
