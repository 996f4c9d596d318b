"""The geometry of an ellipsoid: its coefficients as a quadric, its axes, and distances to it."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch._support.small_factors import solve, symmetric_eigen

if TYPE_CHECKING:
    from jaxtyping import Float


class Ellipsoid(NamedTuple):
    """``(p - center)ᵀ shape (p - center) = 1``."""

    center: Float[Tensor, "*batch 3"]
    shape: Float[Tensor, "*batch 3 3"]


def monomials(points: Float[Tensor, "*batch N 3"]) -> Float[Tensor, "*batch N 9"]:
    """x², y², z², xy, xz, yz, x, y, z: the regressors of (36) of the paper.

    Example:
        >>> monomials(torch.tensor([[1.0, 2.0, 3.0]]))
        tensor([[1., 4., 9., 2., 3., 6., 1., 2., 3.]])
    """
    x, y, z = points.unbind(-1)
    return torch.stack([x * x, y * y, z * z, x * y, x * z, y * z, x, y, z], -1)


def ellipsoid_from_coefficients(coef: Float[Tensor, "*batch 9"]) -> Ellipsoid:
    """Centre (38) and shape matrix A₁ of the paper's (39) from the coefficients of (36).

    Example:
        >>> ellipsoid_from_coefficients(torch.tensor([0.25, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])).shape
        tensor([[0.2500, 0.0000, 0.0000],
                [0.0000, 1.0000, 0.0000],
                [0.0000, 0.0000, 1.0000]])
    """
    a1, a2, a3, a4, a5, a6 = coef[..., :6].unbind(-1)
    rows = [a1, a4 / 2, a5 / 2, a4 / 2, a2, a6 / 2, a5 / 2, a6 / 2, a3]
    A = torch.stack(rows, -1).unflatten(-1, (3, 3))
    solution = solve(A, coef[..., 6:].unsqueeze(-1)).squeeze(-1)
    center = -0.5 * solution
    size = 1.0 + torch.einsum("...i,...ij,...j->...", center, A, center)
    return Ellipsoid(center, A / size[..., None, None])


def coefficients_from_ellipsoid(ellipsoid: Ellipsoid) -> Float[Tensor, "*batch 9"]:
    """Coefficients of (36); they grow without limit when the surface passes through the origin."""
    center, shape = ellipsoid
    moved = torch.einsum("...ij,...j->...i", shape, center)
    size = 1.0 - torch.einsum("...i,...i->...", center, moved)
    a = shape
    terms = [a[..., 0, 0], a[..., 1, 1], a[..., 2, 2], 2 * a[..., 0, 1], 2 * a[..., 0, 2], 2 * a[..., 1, 2]]
    return torch.cat([torch.stack(terms, -1), -2.0 * moved], -1) / size[..., None]


def symmetric_root(shape: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Symmetric square root of positive definite matrices."""
    values, vectors = symmetric_eigen(shape)
    return vectors @ torch.diag_embed(values.sqrt()) @ vectors.mT


_SYMMETRIC = (0, 1, 2, 1, 3, 4, 2, 4, 5)
"""For each element of a symmetric matrix, row by row, its index in the upper triangle."""


def ellipsoid_from_root(theta: Float[Tensor, "*batch 9"]) -> Ellipsoid:
    """The ellipsoid ``|L (p - center)| = 1`` from its centre and the upper triangle of the symmetric L."""
    root = theta[..., 3:][..., list(_SYMMETRIC)].unflatten(-1, (3, 3))
    return Ellipsoid(theta[..., :3], root @ root)


def sampson_distance(theta: Float[Tensor, " 9"], points: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
    """First-order distance of points to an ellipsoid, in their unit, positive outside.

    With y = L (p - center) it is ``(|y| - 1) / |∇_p |y||``. It differs from the orthogonal distance e by at most about
    ``e² b / (2 a²)``, with a and b the shortest and the longest semi-axis; at the ends of the axes it is exact.

    Args:
        theta: parameters as in :func:`ellipsoid_from_root`, in the unit of the points.
        points: (N, 3).

    Example:
        >>> theta = torch.tensor([0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 1.0, 0.0, 1.0])
        >>> sampson_distance(theta, torch.tensor([[3.0, 0.0, 0.0], [0.0, 0.5, 0.0]]))
        tensor([ 1.0000, -0.5000])
    """
    root = theta[3:][list(_SYMMETRIC)].unflatten(-1, (3, 3))
    y = (points - theta[:3]) @ root
    return distance_along(y, root)


def distance_along(y: Float[Tensor, "*batch N 3"], root: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch N"]:
    """:func:`sampson_distance` from y = L (p - center) and the symmetric L."""
    # keeps the distance of the centre finite
    tiny = torch.finfo(y.dtype).eps ** 2
    norm = (y.square().sum(-1) + tiny).sqrt()
    return (norm - 1.0) * norm / ((y @ root).square().sum(-1) + tiny).sqrt()


def axes_of(shape: Tensor) -> tuple[Tensor, Tensor]:
    """Semi-axes in ascending order, and the rotation (determinant +1) whose columns are their directions."""
    values, vectors = symmetric_eigen(shape)
    vectors = vectors.flip(-1)
    # the largest component of each axis is positive, so that the result does not depend on the solver
    index = vectors.abs().argmax(-2, keepdim=True)
    vectors = vectors * torch.sign(torch.gather(vectors, -2, index))
    vectors = torch.cat([vectors[..., :2], vectors[..., 2:] * torch.linalg.det(vectors)[..., None, None]], -1)
    return values.flip(-1).rsqrt(), vectors
