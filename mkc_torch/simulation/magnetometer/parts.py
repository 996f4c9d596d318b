"""Start surfaces if all samples do not determine an ellipsoid: the ellipsoid of a part, or the nearest sphere."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.calibration.coverage import coverage
from mkc_torch.calibration.ellipsoid_fit import MAX_SCATTER, MIN_INFORMATION, MIN_POINTS, EllipsoidFit
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.linear import LeastTrimmedSquares, RankDeficientError

if TYPE_CHECKING:
    from jaxtyping import Float, Int

INFORMATION = 0.02
"""Smallest information of a part's directions, as a share of even coverage: below it, noise shrinks the ellipsoid to a
third, and the coverage is overestimated."""

SCATTER = 0.04
"""Largest scatter of a part's samples about its ellipsoid, as a share of the radius: a sensor in a steady field
scatters by 0.01 to 0.03, and in this part nothing must have changed the sensor."""

_PARTS = (2, 3, 4)
"""Numbers of equal parts to try, half a part apart: a single change of the sensor leaves one of them unaffected."""


class Surface(NamedTuple):
    """An ellipsoid: centre, matrix to a sphere, and radius of that sphere; from samples ``first`` to ``last`` - 1."""

    center: Float[Tensor, " 3"]
    matrix: Float[Tensor, "3 3"]
    radius: float
    first: int
    last: int


def ellipsoid_of_a_part(points: Float[Tensor, "N 3"], chosen: Int[Tensor, " n"]) -> Surface | None:
    """The ellipsoid of the part of a recording that determines it best; None if no part determines an ellipsoid.

    Args:
        points: measurements in the order of time.
        chosen: numbers of the samples in use, ascending.

    Example:
        >>> from mkc_torch.calibration.coverage import fibonacci_sphere
        >>> points = 45.0 * fibonacci_sphere(400)[torch.randperm(400)]
        >>> points[200:] += torch.tensor([60.0, 0.0, 0.0])
        >>> found = ellipsoid_of_a_part(points, torch.arange(400))
        >>> round(found.radius, 3), found.last - found.first <= 200
        (45.0, True)
    """
    best: tuple[float, Surface] | None = None
    for first, last in _parts(len(chosen)):
        part = chosen[first:last]
        try:
            fit = EllipsoidFit().fit(points[part])
        except NotIdentifiableError:
            continue
        known = coverage(points[part] - fit.center_).information
        if known < INFORMATION:
            continue
        spread = float(robust_scale(fit.residual_.unsqueeze(-1)) / fit.radius_)
        if spread > SCATTER:
            continue
        # standard error of its worst coefficient, up to a factor
        error = spread / (len(part) * known) ** 0.5
        if best is None or error < best[0]:
            surface = Surface(fit.center_, fit.calibration_matrix_, float(fit.radius_), int(part[0]), int(part[-1]) + 1)
            best = error, surface
    return None if best is None else best[1]


def sphere_of_all(points: Float[Tensor, "N 3"], chosen: Int[Tensor, " n"]) -> Surface | None:
    """The sphere nearest to the samples; None if they scatter widely about it, or cover too few directions."""
    taken = points[chosen]
    middle = taken.median(0).values
    away = taken - middle
    size = torch.linalg.vector_norm(away, dim=-1).median()
    if len(taken) < MIN_POINTS or not bool(size > 0):
        return None
    scaled = away / size
    regressors = torch.cat([2.0 * scaled, torch.ones_like(scaled[:, :1])], -1)
    try:
        coefficients = LeastTrimmedSquares().fit(regressors, scaled.square().sum(-1)).coef_
    except RankDeficientError:
        return None
    square = coefficients[3] + coefficients[:3].square().sum()
    if not bool(square > 0):
        return None
    center, radius = middle + size * coefficients[:3], float(size * square.sqrt())
    field = taken - center
    distance = torch.linalg.vector_norm(field, dim=-1, keepdim=True) - radius
    near = distance[:, 0].abs() < MAX_SCATTER * radius
    if float(robust_scale(distance)) > MAX_SCATTER * radius:
        return None
    if coverage(field[near]).information < MIN_INFORMATION:
        return None
    return Surface(center, torch.eye(3, dtype=points.dtype), radius, 0, len(points))


def _parts(count: int) -> Iterator[tuple[int, int]]:
    for parts in _PARTS:
        length = count // parts
        if length >= 10 * MIN_POINTS:
            yield from ((k * length // 2, k * length // 2 + length) for k in range(2 * parts - 1))
