"""Maximise a smooth function of a few numbers by Newton's method with finite differences."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float

_FIRST = 0.05
"""Width of the first differences, in each number."""

_LOSS = 0.5
"""Loss of the function over the width of later differences; for a log-likelihood, a standard error."""

_WIDEST = 0.2
"""Width of a difference at most, in any number."""

_FARTHEST = 0.6
"""Length of a Newton step at most, in any number."""

_SHARES = np.array([1.0, 0.5, 0.2, 0.05])
"""Shares of a Newton step that are tried together."""

_SETTLED = 1e-3
"""Gain of a step below which the iteration has converged."""


def peak(
    values: Callable[[Float[np.ndarray, "B k"]], Float[np.ndarray, " B"]],
    start: Float[np.ndarray, " k"],
    rounds: int = 8,
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
    """Find the local maximum near a start, and the negative Hessian there.

    The numbers have a scale of 1, such as logarithms. Differences are taken along the axes of the function's
    curvature, so that the iteration follows a narrow ridge.

    Args:
        values: function values at B points; -inf where the function is not defined.
        start: (k,), near the maximum.
        rounds: Newton steps at most; 0 for the Hessian at the start only.

    Example:
        >>> at, curvature = peak(lambda x: -2.0 * (x[:, 0] - 0.3) ** 2 - (x[:, 1] - x[:, 0]) ** 2, np.zeros(2))
        >>> at.round(3).tolist(), curvature.round(3).tolist()
        ([0.3, 0.3], [[6.0, -2.0], [-2.0, 2.0]])
    """
    at, directions, gained = start, _FIRST * np.eye(len(start)), np.inf
    slope, curvature, here = _parabola(values, at, directions)
    for _ in range(rounds):
        step = directions @ _newton(slope, curvature)
        step *= min(1.0, _FARTHEST / max(float(np.abs(step).max()), 1e-300))
        steps = at + _SHARES[:, None] * step
        found = np.nan_to_num(values(steps), nan=-np.inf)
        best = int(found.argmax())
        settled, gained = gained < _SETTLED, found[best] - here
        if gained > 0.0:
            at = steps[best]
        directions = _curvature_axes(directions, curvature)
        slope, curvature, here = _parabola(values, at, directions)
        if settled and gained < _SETTLED:
            break
    inverse = np.linalg.inv(directions)
    return at, inverse.T @ curvature @ inverse


def _parabola(
    values: Callable[[Float[np.ndarray, "B k"]], Float[np.ndarray, " B"]],
    at: Float[np.ndarray, " k"],
    directions: Float[np.ndarray, "k k"],
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"], float]:
    """Gradient, negative Hessian and value at a point, in the basis of the columns of ``directions``."""
    k, steps = len(at), directions.T
    pairs = [(a, b) for a in range(k) for b in range(a)]
    mixed = [steps[a] + steps[b] for a, b in pairs]
    found = values(np.stack([at, *(at + steps), *(at - steps), *(at + both for both in mixed)]))
    here, more, less, both = found[0], found[1 : k + 1], found[k + 1 : 2 * k + 1], found[2 * k + 1 :]
    with np.errstate(invalid="ignore"):  # values may be infinite
        curvature, slope = np.diag(2.0 * here - more - less), 0.5 * (more - less)
        for (a, b), value in zip(pairs, both, strict=True):
            rise = value - here - slope[a] - slope[b]
            curvature[a, b] = curvature[b, a] = -rise - 0.5 * (curvature[a, a] + curvature[b, b])
    return slope, curvature, float(here)


def _newton(slope: Float[np.ndarray, " k"], curvature: Float[np.ndarray, "k k"]) -> Float[np.ndarray, " k"]:
    """Newton step to a parabola's maximum; uphill where the curvature is not positive."""
    if not (np.isfinite(slope).all() and np.isfinite(curvature).all()):
        return np.zeros_like(slope)
    size, axes = np.linalg.eigh(curvature)
    newton_step: np.ndarray = axes @ (axes.T @ slope / np.maximum(np.abs(size), 1e-9))
    return newton_step


def _curvature_axes(
    directions: Float[np.ndarray, "k k"], curvature: Float[np.ndarray, "k k"]
) -> Float[np.ndarray, "k k"]:
    """Eigenvectors of a curvature given in the basis ``directions``, scaled for a loss of ``_LOSS`` along each."""
    if not np.isfinite(curvature).all():
        return 0.5 * directions
    size, axes = np.linalg.eigh(curvature)
    own = directions @ axes * np.sqrt(2.0 * _LOSS / np.maximum(np.abs(size), 1e-12))
    shortened: np.ndarray = own * np.minimum(1.0, _WIDEST / np.abs(own).max(0))
    return shortened
