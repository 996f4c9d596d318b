"""Exchange of a point of the support for another point, as long as the determinant of the covariance decreases.

Hawkins, "The feasible solution algorithm for the minimum covariance determinant estimator in multivariate data",
Computational Statistics & Data Analysis 17 (1994) 197-210.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.covariance._moments import moments_of

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_CHUNK = 1 << 22
"""Pairs of points processed at once."""


def exchange(points: Float[Tensor, "B N p"], counts: Bool[Tensor, "B N"]) -> Bool[Tensor, "B N"]:
    """The support after exchanges until none lowers the determinant; a flat support is returned unchanged."""
    parts = zip(*(part.split(max(1, _CHUNK // points.shape[-2] ** 2)) for part in (points, counts)), strict=True)
    return torch.cat([_exchange(*part) for part in parts])


def _exchange(points: Float[Tensor, "B N p"], counts: Bool[Tensor, "B N"]) -> Bool[Tensor, "B N"]:
    counts = counts.clone()
    N = points.shape[-2]
    h = int(counts[0].sum())
    limit = 1.0 - 1e3 * torch.finfo(points.dtype).eps
    active = torch.arange(points.shape[0], device=points.device)
    while active.numel() > 0:
        mine, keep = points[active], counts[active]
        mean, covariance = moments_of(mine, keep, mine.new_zeros(mine.shape[0], mine.shape[-1]))
        factor, info = torch.linalg.cholesky_ex((h - 1) * covariance)
        white = torch.linalg.solve_triangular(factor, (mine - mean.unsqueeze(-2)).mT, upper=False)
        product = torch.matmul(white.mT, white)
        square = product.diagonal(dim1=-2, dim2=-1)
        out, into = square.unsqueeze(-1), square.unsqueeze(-2)
        # determinant after over determinant before, by the rank-two update of the scatter
        ratio = 1.0 - (1.0 + 1.0 / h) * out + 2.0 / h * product + (1.0 - 1.0 / h) * into - out * into + product.square()
        allowed = keep.unsqueeze(-1) & ~keep.unsqueeze(-2)
        least, pair = torch.where(allowed, ratio, torch.inf).flatten(-2).min(-1)
        # a flat set gives NaN, which compares False
        falls = (least < limit) & (info == 0)
        active, pair = active[falls], pair[falls]
        counts[active, pair // N] = False
        counts[active, pair % N] = True
    return counts
