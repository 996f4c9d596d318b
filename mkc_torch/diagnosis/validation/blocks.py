"""Mean squares of residuals by blocks, and intervals of their ratios.

Samples of a residual in open loop are correlated over a large part of a recording, so the samples are not
independent. Means over long consecutive blocks nearly are, and a few of them are enough for Student's t interval,
which allows for their small number. A bootstrap of so few blocks gives intervals that are too short: its variance is
(B - 1) / B of theirs, and its quantiles are Gaussian (Efron & Tibshirani, "An Introduction to the Bootstrap", 1993,
12.2). Both models are compared on the same blocks, so that a difficult block counts once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.student_t import student_quantile
from mkc_torch.diagnosis.io.training import BlockSquares
from mkc_torch.diagnosis.thresholds import LEVEL

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

PART = 0.1
"""Share of a trajectory from which its initial states are estimated, and length of a block: ten parts, of which nine
are predicted."""

_FEWEST = 3
"""Blocks of an interval at least: two leave one degree of freedom, whose t is 12.7."""


@dataclass(frozen=True)
class Ratio:
    """A ratio of root mean squares with its 95 % interval; the interval is nan with fewer than three blocks."""

    value: float
    low: float
    high: float


def block_numbers(run: Int[Tensor, " N"], predicted: Bool[Tensor, " N"]) -> Int[Tensor, " N"]:
    """Return the number of each sample's block, -1 for samples that are not predicted.

    Blocks are consecutive predicted samples of one run. Nine blocks are shared among the runs by their samples, with
    at least one for each run.

    Args:
        run: (N,), number of each sample's run, ascending.
        predicted: (N,), False for the samples that the initial states were estimated from.

    Example:
        >>> block_numbers(torch.zeros(20, dtype=torch.long), torch.arange(20) >= 2)[:7].tolist()
        [-1, -1, 0, 0, 1, 1, 2]
    """
    wanted = round(1.0 / PART) - 1
    block = torch.full_like(run, -1)
    total, begun = int(predicted.sum()), 0
    for number in run.unique().tolist():
        rows = (predicted & (run == number)).nonzero().squeeze(-1)
        if not len(rows):
            continue
        count = min(max(1, round(wanted * len(rows) / total)), len(rows))
        block[rows] = begun + (torch.arange(len(rows)) * count).div(len(rows), rounding_mode="floor")
        begun += count
    return block


def block_squares(residual: Float[Tensor, " N"], block: Int[Tensor, " N"]) -> BlockSquares:
    """Return the mean squares of a residual; samples that are not finite, or in no block, are left out.

    Args:
        residual: (N,), of one output.
        block: (N,), from :func:`block_numbers`.

    Example:
        >>> block_squares(torch.tensor([9.0, 1.0, 1.0, 2.0]), torch.tensor([-1, 0, 0, 1])).squares
        (1.0, 4.0)
    """
    used = residual.isfinite() & (block >= 0)
    count = int(block.max()) + 1
    size = torch.bincount(block[used], minlength=count)
    total = torch.zeros(count, dtype=torch.float64).index_add(0, block[used], residual[used].double().square())
    kept = size > 0
    return BlockSquares(tuple((total[kept] / size[kept]).tolist()), tuple(size[kept].tolist()))


def paired_ratio(over: BlockSquares, under: BlockSquares) -> Ratio:
    """Return the ratio of two models' root mean squares on the same blocks, and its interval.

    The interval of the logarithm is Student's t over the blocks' influences, the linearised contributions of each
    block.

    Example:
        >>> same = BlockSquares((1.0, 2.0, 1.5, 1.2), (10, 10, 10, 10))
        >>> half = BlockSquares((0.25, 0.5, 0.375, 0.3), (10, 10, 10, 10))
        >>> paired_ratio(half, same)
        Ratio(value=0.5, low=0.5, high=0.5)
    """
    shares = [a - b for a, b in zip(_shares(over), _shares(under), strict=True)]
    return _interval(over.rmse, under.rmse, [shares])


def independent_ratio(over: BlockSquares, under: BlockSquares) -> Ratio:
    """Return the ratio of root mean squares in two recordings, and its interval with Welch's degrees of freedom.

    Example:
        >>> loud, quiet = BlockSquares((4.0, 4.4, 3.6), (9, 9, 9)), BlockSquares((1.0, 1.1, 0.9), (5, 5, 5))
        >>> found = independent_ratio(loud, quiet)
        >>> found.value, found.low < 2.0 < found.high
        (2.0, True)
    """
    deviations = [
        [share - n / sum(each.samples) for share, n in zip(_shares(each), each.samples, strict=True)]
        for each in (over, under)
    ]
    return _interval(over.rmse, under.rmse, deviations)


def _shares(each: BlockSquares) -> list[float]:
    """Return each block's share of the sum of squares; equal shares for a residual of 0."""
    parts = [square * n for square, n in zip(each.squares, each.samples, strict=True)]
    total = sum(parts)
    return [part / total if total > 0 else n / sum(each.samples) for part, n in zip(parts, each.samples, strict=True)]


def _interval(over: float, under: float, deviations: Sequence[Sequence[float]]) -> Ratio:
    """Return the ratio with the interval of the sum of independent groups of deviations of log mean squares."""
    if not under > 0.0:
        value = math.nan if over == 0.0 or math.isnan(over) else math.inf
        return Ratio(value, math.nan, math.nan)
    value = over / under
    if min(map(len, deviations)) < _FEWEST or value == 0.0 or not math.isfinite(value):
        return Ratio(value, math.nan, math.nan)
    parts = [(len(each), len(each) / (len(each) - 1.0) * sum(d * d for d in each)) for each in deviations]
    variance = sum(part for _, part in parts)
    if variance == 0.0:
        return Ratio(value, value, value)
    # Welch, Biometrika 34 (1947), 28; for one group, its number less 1
    freedom = variance**2 / sum(part**2 / (count - 1.0) for count, part in parts)
    reach = 0.5 * _quantile(freedom) * math.sqrt(variance)
    return Ratio(value, value * math.exp(-reach), value * math.exp(reach))


@cache  # a bisection, and the outputs of a recording have as many blocks as each other
def _quantile(freedom: float) -> float:
    return float(student_quantile(1.0 - LEVEL, torch.tensor(freedom)))
