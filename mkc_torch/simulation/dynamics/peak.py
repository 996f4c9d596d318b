"""The peak of a smooth function of a few numbers near a point, by Newton's method on differences."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["peak"]

_FIRST = 0.05
"""By which each number is moved for the first differences."""

_LOSS = 0.5
"""Of the value, by which later differences look away from a point; a standard error, of a log-likelihood."""

_WIDEST, _FARTHEST = 0.2, 0.6
"""A difference, and a step, in any of the numbers at most: a parabola is not trusted any farther."""

_SHARES = np.array([1.0, 0.5, 0.2, 0.05])
"""Of a Newton step, tried together."""

_SETTLED = 1e-3
"""Gain below which the peak is reached."""


def peak(
    values: Callable[[Float[np.ndarray, "B k"]], Float[np.ndarray, " B"]],
    start: Float[np.ndarray, " k"],
    rounds: int = 8,
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
    """The point of the largest value near a start, and the negative of the function's second derivatives there.

    The numbers are of a scale of one, such as logarithms. Differences are along the axes of the function's own
    curvature, so that a narrow ridge is followed.

    Args:
        values: of B points; -inf where there is none.
        start: near the peak.
        rounds: steps at most; none for the second derivatives at the start.

    Example:
        >>> at, curvature = peak(lambda x: -2.0 * (x[:, 0] - 0.3) ** 2 - (x[:, 1] - x[:, 0]) ** 2, np.zeros(2))
        >>> at.round(3).tolist(), curvature.round(3).tolist()
        ([0.3, 0.3], [[6.0, -2.0], [-2.0, 2.0]])
    """
    at, ways, gained = start, _FIRST * np.eye(len(start)), np.inf
    slope, bend, here = _parabola(values, at, ways)
    for _ in range(rounds):
        step = ways @ _newton(slope, bend)
        step *= min(1.0, _FARTHEST / max(float(np.abs(step).max()), 1e-300))
        steps = at + _SHARES[:, None] * step
        found = np.nan_to_num(values(steps), nan=-np.inf)
        best = int(found.argmax())
        settled, gained = gained < _SETTLED, found[best] - here
        if gained > 0.0:
            at = steps[best]
        ways = _own_ways(ways, bend)
        slope, bend, here = _parabola(values, at, ways)
        if settled and gained < _SETTLED:
            break
    inverse = np.linalg.inv(ways)
    return at, inverse.T @ bend @ inverse


def _parabola(
    values: Callable[[Float[np.ndarray, "B k"]], Float[np.ndarray, " B"]],
    at: Float[np.ndarray, " k"],
    ways: Float[np.ndarray, "k k"],
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"], float]:
    """Slope, negative second derivatives and value at a point, along some ways, the columns."""
    k, one = len(at), ways.T
    pairs = [(a, b) for a in range(k) for b in range(a)]
    mixed = [one[a] + one[b] for a, b in pairs]
    found = values(np.stack([at, *(at + one), *(at - one), *(at + both for both in mixed)]))
    here, more, less, both = found[0], found[1 : k + 1], found[k + 1 : 2 * k + 1], found[2 * k + 1 :]
    with np.errstate(invalid="ignore"):  # where there is no value
        bend, slope = np.diag(2.0 * here - more - less), 0.5 * (more - less)
        for (a, b), value in zip(pairs, both, strict=True):
            rise = value - here - slope[a] - slope[b]
            bend[a, b] = bend[b, a] = -rise - 0.5 * (bend[a, a] + bend[b, b])
    return slope, bend, float(here)


def _newton(slope: Float[np.ndarray, " k"], bend: Float[np.ndarray, "k k"]) -> Float[np.ndarray, " k"]:
    """The way to the peak of a parabola; where the function does not bend down, upwards."""
    if not (np.isfinite(slope).all() and np.isfinite(bend).all()):
        return np.zeros_like(slope)
    size, axes = np.linalg.eigh(bend)
    way: np.ndarray = axes @ (axes.T @ slope / np.maximum(np.abs(size), 1e-9))
    return way


def _own_ways(ways: Float[np.ndarray, "k k"], bend: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k k"]:
    """The axes of a curvature that was found along some ways, as long as the function loses half a unit along each."""
    if not np.isfinite(bend).all():
        return 0.5 * ways
    size, axes = np.linalg.eigh(bend)
    own = ways @ axes * np.sqrt(2.0 * _LOSS / np.maximum(np.abs(size), 1e-12))
    shortened: np.ndarray = own * np.minimum(1.0, _WIDEST / np.abs(own).max(0))
    return shortened
