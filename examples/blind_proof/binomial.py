"""Exact confidence intervals of shares, and a test for uniformity."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Share:
    """The share ``count / total`` with its confidence interval."""

    count: int
    total: int
    low: float
    high: float

    @property
    def value(self) -> float:
        """The share; NaN if ``total`` is 0."""
        return self.count / self.total if self.total else math.nan


def share(count: int, total: int, level: float = 0.95) -> Share:
    """Return the share with its Clopper-Pearson interval (1934), whose coverage is at least the level.

    Example:
        >>> found = share(0, 10)
        >>> found.low, round(found.high, 4)
        (0.0, 0.3085)
    """
    if not 0 <= count <= total:
        raise ValueError(f"Expected 0 <= count <= total but got {count} of {total}.")
    half = 0.5 * (1.0 - level)
    low = 0.0 if count == 0 else _root(lambda p: _at_least(count, total, p) - half)
    high = 1.0 if count == total else _root(lambda p: half - (1.0 - _at_least(count + 1, total, p)))
    return Share(count, total, low, high)


def _at_least(count: int, total: int, p: float) -> float:
    """Return P(X >= count) for a binomial variable."""
    k = torch.arange(count, total + 1, dtype=torch.float64)
    n = torch.tensor(float(total), dtype=torch.float64)
    ways = torch.lgamma(n + 1) - torch.lgamma(k + 1) - torch.lgamma(n - k + 1)
    return float(torch.exp(ways + k * math.log(p) + (n - k) * math.log1p(-p)).sum())


def _root(increasing: Callable[[float], float]) -> float:
    low, high = 0.0, 1.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if increasing(middle) > 0 else (middle, high)
    return 0.5 * (low + high)


def uniformity(values: Sequence[float]) -> tuple[float, float]:
    """Return the Kolmogorov distance from the uniform distribution on [0, 1], and its p-value.

    References:
        Stephens, "EDF statistics for goodness of fit and some comparisons", JASA 69 (1974), table 1A, for the factor.

    Example:
        >>> uniformity([(k + 0.5) / 100 for k in range(100)])
        (0.005, 1.0)
    """
    if not values:
        return math.nan, math.nan
    x = torch.tensor(sorted(values), dtype=torch.float64)
    n = len(x)
    steps = torch.arange(n + 1, dtype=torch.float64) / n
    distance = max(float((steps[1:] - x).max()), float((x - steps[:-1]).max()))
    scaled = distance * (math.sqrt(n) + 0.12 + 0.11 / math.sqrt(n))
    if scaled < 0.2:  # the series does not converge here; p is 1 to twelve digits
        return round(distance, 12), 1.0
    series = sum((-1) ** (k - 1) * math.exp(-2.0 * (k * scaled) ** 2) for k in range(1, 101))
    return round(distance, 12), min(max(2.0 * series, 0.0), 1.0)
