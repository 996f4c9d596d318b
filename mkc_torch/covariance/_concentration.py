"""The h points whose covariance has the smallest determinant, by concentration steps from many elemental starts.

Rousseeuw & Van Driessen, "A fast algorithm for the minimum covariance determinant estimator", Technometrics 41 (1999)
212-223. A step takes mean and covariance of the h points with the smallest distances by the previous mean and
covariance; by their theorem 1 the determinant never increases.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch._support.elemental_sets import drawn_samples, drawn_sets
from mkc_torch.covariance._exchange import exchange

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


_CHUNK = 1 << 20
"""Values processed at once."""

_SCREENING_SAMPLES = 1500
"""Samples of the first steps, at most."""

FAR = 1e4
"""Standard deviation of standardised points above which the set contains outliers."""

_EXCHANGE_SAMPLES = 200
"""Samples up to which points are exchanged: concentration steps alone end in too many local minima."""

_EXCHANGED = 20
"""Supports in which points are exchanged."""


class Ellipsoids(NamedTuple):
    """Stack of ellipsoids: mean, whitening matrix W (distance ``|W (x - mean)|``), log determinant (-inf if flat)."""

    mean: Float[Tensor, "B S p"]
    whitening: Float[Tensor, "B S p p"]
    log_determinant: Float[Tensor, "B S"]

    def at(self, index: Int[Tensor, "B S_"]) -> Ellipsoids:
        """The ellipsoids at ``index`` of each problem's stack."""
        batch = torch.arange(index.shape[0], device=index.device).unsqueeze(-1)
        return Ellipsoids(*(part[batch, index] for part in self))


@dataclass(frozen=True)
class Support:
    """Mask of the supporting points, the number of steps, and whether they converged."""

    counts: Bool[Tensor, "B N"]
    n_iter: int
    converged: Bool[Tensor, B]


def singular_below(dtype: torch.dtype) -> float:
    """Conditional variance of a column given others, relative to its variance, below which rounding dominates."""
    return 512.0 * torch.finfo(dtype).eps


def _ellipsoids(points: Float[Tensor, "B S k p"]) -> Ellipsoids:
    """Ellipsoids of sets of standardised points; a flat ellipsoid gets a small thickness for its distances.

    A set with far outliers looks flat too, because rounding dominates the other points. Its determinant, with the
    thickness, is still larger than that of any set without far outliers.
    """
    mean = points.mean(-2)
    error = points - mean.unsqueeze(-2)
    covariance = torch.matmul(error.mT, error) / (points.shape[-2] - 1)
    limit = singular_below(points.dtype)
    deviation = covariance.diagonal(dim1=-2, dim2=-1).sqrt().clamp(min=limit)
    shape = covariance / deviation.unsqueeze(-1) / deviation.unsqueeze(-2)
    factor, info = torch.linalg.cholesky_ex(shape)
    flat = (info > 0) | ~(factor.diagonal(dim1=-2, dim2=-1).amin(-1).square() > limit)
    if flat.any():
        eye = torch.eye(shape.shape[-1], dtype=shape.dtype, device=shape.device)
        factor[flat] = torch.linalg.cholesky_ex(shape[flat] + 10.0 * limit * eye).L
    eye = torch.eye(shape.shape[-1], dtype=shape.dtype, device=shape.device)
    whitening = torch.linalg.solve_triangular(factor, eye, upper=False) / deviation.unsqueeze(-2)
    pivots = factor.diagonal(dim1=-2, dim2=-1) * deviation
    flat = flat & (deviation.amax(-1) < FAR)
    return Ellipsoids(mean, whitening, torch.where(flat, -math.inf, 2.0 * pivots.log().sum(-1)))


def _closest(points: Float[Tensor, "B N p"], ellipsoids: Ellipsoids, h: int) -> Int[Tensor, "B S h"]:
    """Indices of the h points with the smallest distances, unordered."""
    error = points.unsqueeze(1) - ellipsoids.mean.unsqueeze(-2)
    distance = torch.matmul(error, ellipsoids.whitening.mT).square().sum(-1)
    return distance.topk(h, dim=-1, largest=False, sorted=False).indices


def _points_at(points: Float[Tensor, "B N p"], index: Int[Tensor, "#B S k"]) -> Float[Tensor, "B S k p"]:
    batch = torch.arange(points.shape[0], device=points.device).view(-1, 1, 1)
    return points[batch, index]


def _step(points: Float[Tensor, "B N p"], ellipsoids: Ellipsoids, h: int) -> Ellipsoids:
    """A concentration step of every ellipsoid, in chunks."""
    size = max(1, _CHUNK // points.numel())
    parts = zip(*(part.split(size, dim=1) for part in ellipsoids), strict=True)
    moved = [_ellipsoids(_points_at(points, _closest(points, Ellipsoids(*part), h))) for part in parts]
    return Ellipsoids(*(torch.cat(part, dim=1) for part in zip(*moved, strict=True)))


def _starts(points: Float[Tensor, "B N p"], count: int, seed: int) -> Ellipsoids:
    """Ellipsoids of ``count`` random sets of p + 1 points, and the ellipsoid of all points."""
    N, p = points.shape[-2:]
    elemental = _ellipsoids(_points_at(points, drawn_sets(seed, count, p + 1, N, points.device).unsqueeze(0)))
    whole = _ellipsoids(points.unsqueeze(1))
    return Ellipsoids(*(torch.cat(both, dim=1) for both in zip(elemental, whole, strict=True)))


def concentrate(
    points: Float[Tensor, "B N p"], h: int, *, starts: int = 500, max_iter: int = 100, seed: int = 0
) -> Support:
    """The support of smallest determinant.

    Two steps from every start on at most 1500 points, then the best candidates to convergence on all points. Up to 200
    points, the best supports are then improved by exchanging points.

    Args:
        points: standardised points.
        h: number of supporting points.
        starts: number of random sets of p + 1 points.
        max_iter: maximum number of steps.
        seed: seed of the random sets; all problems have the same sets, so that their results are independent.
    """
    per_problem = min(points.shape[-2], _SCREENING_SAMPLES) * points.shape[-1]
    parts = points.split(max(1, _CHUNK // (per_problem * 100)))
    found = [_concentrate(part, h, starts, max_iter, seed) for part in parts]
    return Support(
        counts=torch.cat([f.counts for f in found]),
        n_iter=max(f.n_iter for f in found),
        converged=torch.cat([f.converged for f in found]),
    )


def _concentrate(points: Float[Tensor, "B N p"], h: int, starts: int, max_iter: int, seed: int) -> Support:
    N = points.shape[-2]
    small, few = points, h
    if N > _SCREENING_SAMPLES:
        keep = drawn_samples(seed, _SCREENING_SAMPLES, N, points.device)
        small, few = points[:, keep], max(1, round(h / N * _SCREENING_SAMPLES))
    found = _starts(small, starts, seed)
    for _ in range(2):
        found = _step(small, found, few)
    candidates = min(50 if N <= _EXCHANGE_SAMPLES else 10, starts + 1)
    found = found.at(found.log_determinant.topk(candidates, dim=1, largest=False).indices)
    found, n_iter, moving = _converged(points, found, h, max_iter)
    if N > _EXCHANGE_SAMPLES:
        best = found.log_determinant.argmin(1, keepdim=True)
        index = _closest(points, found.at(best), h)
        moving = moving.gather(1, best)
    else:
        index = _exchanged(points, found, h)
        # the exchange runs until it converges
        moving = torch.zeros_like(moving[:, :1])
    counts = torch.zeros(points.shape[:2], dtype=torch.bool, device=points.device)
    return Support(counts.scatter_(1, index.squeeze(1), True), n_iter, ~moving.squeeze(1))


def _converged(
    points: Float[Tensor, "B N p"], found: Ellipsoids, h: int, max_iter: int
) -> tuple[Ellipsoids, int, Bool[Tensor, "B S"]]:
    """Steps until no determinant decreases. Returns the ellipsoids, the number of steps and the mask not converged."""
    tolerance = 1e2 * torch.finfo(points.dtype).eps
    # determinants of a subsample are not comparable with those of all points
    found = found._replace(log_determinant=torch.full_like(found.log_determinant, math.inf))
    moving = torch.ones_like(found.log_determinant, dtype=torch.bool)
    n_iter = 0
    while n_iter < max_iter and moving.any():
        n_iter += 1
        going = torch.nonzero(moving.any(0)).flatten()
        moved = _step(points, Ellipsoids(*(part[:, going] for part in found)), h)
        falls = moving[:, going] & (found.log_determinant[:, going] - moved.log_determinant > tolerance)
        for part, new in zip(found, moved, strict=True):
            part[:, going] = torch.where(falls.view(*falls.shape, *(1,) * (new.dim() - 2)), new, part[:, going])
        moving[:, going] = falls
    return found, n_iter, moving


def _exchanged(points: Float[Tensor, "B N p"], found: Ellipsoids, h: int) -> Int[Tensor, "B 1 h"]:
    """The best support after exchanges in the best few distinct supports."""
    value, order = found.log_determinant.sort(dim=1)
    same = torch.nn.functional.pad(value.diff(dim=1) < 1e-9, (1, 0))
    value, few = torch.where(same, math.inf, value).topk(min(_EXCHANGED, value.shape[1]), dim=1, largest=False)
    index = _closest(points, found.at(order.gather(1, few)), h)
    counts = torch.zeros(*few.shape, points.shape[-2], dtype=torch.bool, device=points.device).scatter_(2, index, True)
    differs = value < math.inf
    problem, _ = differs.nonzero(as_tuple=True)
    counts[differs] = exchange(points[problem], counts[differs])
    index = counts.nonzero()[:, -1].reshape(index.shape)
    best = _ellipsoids(_points_at(points, index)).log_determinant.argmin(1).view(-1, 1, 1)
    return index.gather(1, best.expand(-1, 1, h))
