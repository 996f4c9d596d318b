"""A quantity measured in several units: its mean, the spread between the units, units that depart, and a trend.

Each unit's true value is the mean plus a normal deviation of standard deviation τ; its estimate adds an error of known
size. τ is that of Paule & Mandel (1982), its interval that of Viechtbauer, "Confidence intervals for the amount of
heterogeneity in meta-analysis" (2007), and intervals of means and slopes are those of Knapp & Hartung (2003).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from mkc_torch._support.student_t import student_quantile, student_tails

LEVEL = 0.95
"""Level of all intervals."""

FEWEST_FOR_DEPARTURE = 4
"""Units from which departures are tested: the others then give two degrees of freedom or more."""

FEWEST_FOR_TREND = 5

_DOUBLINGS = 200
"""Halvings and doublings of a bisection at most."""

_SETTLED = 1e-12
"""Relative width of a bisection's interval at its end."""


@dataclass(frozen=True)
class RandomEffects:
    """A quantity of several units.

    Attributes:
        mean, error: mean over all units, and its standard error.
        low, high: 95 % interval of the mean.
        spread: standard deviation τ between the units, without the errors of their estimates.
        spread_low, spread_high: 95 % interval of τ.
    """

    mean: float
    error: float
    low: float
    high: float
    spread: float
    spread_low: float
    spread_high: float

    @property
    def agree(self) -> bool:
        """Whether the errors alone may explain the differences between the units."""
        return self.spread_low == 0.0


@dataclass(frozen=True)
class Departure:
    """A unit compared with the mean of the others: the distance in its standard errors, and Holm's p-value."""

    unit: int
    score: float
    p_value: float


@dataclass(frozen=True)
class Trend:
    """The change of a quantity per unit of a condition, with its standard error and two-sided p-value."""

    slope: float
    error: float
    p_value: float


def random_effects(values: Sequence[float], errors: Sequence[float]) -> RandomEffects:
    """Return the mean and the spread of a quantity.

    Args:
        values: of at least two units.
        errors: standard errors of the values, positive.

    Raises:
        ValueError: fewer than two units, a value that is not finite, or an error that is not positive.

    Example:
        >>> found = random_effects([1.0, 1.2, 0.8, 1.1], [0.1, 0.1, 0.1, 0.1])
        >>> round(found.mean, 3), round(found.spread, 3), found.agree
        (1.025, 0.138, True)
    """
    x, variance = _checked(values, errors, fewest=2)
    ones = np.ones((len(x), 1))
    spread, weight, factor = _fitted(x, variance, ones)
    mean, error = float((weight * x).sum() / weight.sum()), math.sqrt(factor / weight.sum())
    half = error * _t(len(x) - 1)

    def excess(tau_squared: float) -> float:
        return _dispersion(x, variance, ones, tau_squared)

    low, high = (
        math.sqrt(_decreasing_root(excess, _chi_square(p, len(x) - 1), float(variance.max())))
        for p in (0.5 + 0.5 * LEVEL, 0.5 - 0.5 * LEVEL)
    )
    return RandomEffects(mean, error, mean - half, mean + half, spread, low, high)


def departures(values: Sequence[float], errors: Sequence[float]) -> list[Departure]:
    """Return each unit compared with the others by Student's t; none for fewer than four units.

    Example:
        >>> found = departures([1.0, 1.1, 0.9, 1.0, 2.0], [0.1, 0.1, 0.1, 0.1, 0.1])
        >>> [each.unit for each in found if each.p_value < 0.05]
        [4]
    """
    x, variance = _checked(values, errors, fewest=2)
    if len(x) < FEWEST_FOR_DEPARTURE:
        return []
    scores = []
    for unit in range(len(x)):
        others = np.arange(len(x)) != unit
        spread, weight, factor = _fitted(x[others], variance[others], np.ones((len(x) - 1, 1)))
        mean = (weight * x[others]).sum() / weight.sum()
        scores.append((x[unit] - mean) / math.sqrt(variance[unit] + spread**2 + factor / weight.sum()))
    adjusted = _holm([_p_value(score, len(x) - 2) for score in scores])
    return [Departure(unit, float(score), p) for unit, (score, p) in enumerate(zip(scores, adjusted, strict=True))]


def trend(values: Sequence[float], errors: Sequence[float], condition: Sequence[float]) -> Trend | None:
    """Return the change of a quantity with a condition of the units; None for fewer than five units or one condition.

    Example:
        >>> found = trend([1.0, 1.2, 1.4, 1.6, 1.8], [0.1] * 5, [20.0, 21.0, 22.0, 23.0, 24.0])
        >>> round(found.slope, 3), found.p_value < 0.05
        (0.2, True)
    """
    x, variance = _checked(values, errors, fewest=2)
    at = np.asarray(condition, dtype=np.float64)
    if len(x) < FEWEST_FOR_TREND or not np.isfinite(at).all() or not at.std() > 1e-9 * np.abs(at).max():
        return None
    scaled = (at - at.mean()) / at.std()
    design = np.stack([np.ones(len(x)), scaled], 1)
    _, weight, factor = _fitted(x, variance, design)
    inverse = np.linalg.inv(design.T @ (weight[:, None] * design))
    slope, error = (inverse @ (design.T @ (weight * x)))[1], math.sqrt(factor * inverse[1, 1])
    return Trend(float(slope / at.std()), float(error / at.std()), _p_value(slope / error, len(x) - 2))


def _checked(values: Sequence[float], errors: Sequence[float], fewest: int) -> tuple[np.ndarray, np.ndarray]:
    x, error = (np.asarray(each, dtype=np.float64) for each in (values, errors))
    if x.shape != error.shape or x.ndim != 1 or len(x) < fewest:
        raise ValueError(f"Expected at least {fewest} values with an error each but got {x.shape} and {error.shape}.")
    if not (np.isfinite(x).all() and np.isfinite(error).all() and (error > 0.0).all()):
        raise ValueError("Expected finite values with positive errors; leave out units without an estimate.")
    return x, error**2


def _fitted(x: np.ndarray, variance: np.ndarray, design: np.ndarray) -> tuple[float, np.ndarray, float]:
    """τ of Paule & Mandel, the weights 1 / (error² + τ²), and Knapp & Hartung's factor on variances, at least 1."""
    left = x.shape[0] - design.shape[1]
    squared = _decreasing_root(lambda t: _dispersion(x, variance, design, t), left, float(variance.max()))
    weight = 1.0 / (variance + squared)
    return math.sqrt(squared), weight, max(_dispersion(x, variance, design, squared) / left, 1.0)


def _dispersion(x: np.ndarray, variance: np.ndarray, design: np.ndarray, tau_squared: float) -> float:
    """Weighted sum of squares about the fit, which decreases with τ²."""
    root = np.sqrt(1.0 / (variance + tau_squared))
    solution = np.linalg.lstsq(root[:, None] * design, root * x, rcond=None)[0]
    return float(((root * (x - design @ solution)) ** 2).sum())


def _decreasing_root(function: Callable[[float], float], value: float, scale: float) -> float:
    """Argument, at least 0, at which a decreasing function has a value; 0 where it is below the value already."""
    if function(0.0) <= value:
        return 0.0
    low, high = 0.0, scale
    for _ in range(_DOUBLINGS):
        if function(high) <= value:
            break
        low, high = high, 2.0 * high
    for _ in range(_DOUBLINGS):
        middle = 0.5 * (low + high)
        if high - low <= _SETTLED * high:
            break
        low, high = (middle, high) if function(middle) > value else (low, middle)
    return 0.5 * (low + high)


def _chi_square(level: float, freedom: int) -> float:
    """Quantile of chi square, by bisection of the regularised incomplete gamma function."""

    def above(q: float) -> float:
        half = torch.tensor([0.5 * freedom, 0.5 * q], dtype=torch.float64)
        return float(torch.special.gammaincc(half[0], half[1]))

    return _decreasing_root(above, 1.0 - level, float(freedom))


def _t(freedom: int) -> float:
    return float(student_quantile(LEVEL, torch.tensor(float(freedom), dtype=torch.float64)))


def _p_value(score: float, freedom: int) -> float:
    both = torch.tensor([float(score), float(freedom)], dtype=torch.float64)
    return float(student_tails(both[0], both[1]))


def _holm(p_values: Sequence[float]) -> list[float]:
    """p-values adjusted for their number by Holm's method."""
    order = sorted(range(len(p_values)), key=lambda k: p_values[k])
    adjusted, largest = [0.0] * len(p_values), 0.0
    for rank, k in enumerate(order):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[k]))
        adjusted[k] = largest
    return adjusted
