"""What noise of the points themselves does to a fit through them: a bias, and information that is not there.

Regressors that are made of noisy points hold the square of the noise: it draws the parameters aside, and lends points
that determine no ellipsoid, on two circles say, a curvature that only the noise has. To second order both are half the
variance of the noise times the Laplacian of the moments by the points; less that, the moments are those of the points
without noise (Kukush, Markovsky & Van Huffel, "Consistent estimation in an implicit quadratic measurement error
model", Computational Statistics & Data Analysis 47 (2004)). The noise is taken to be alike in all directions.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch.calibration.ellipsoid import monomials, sampson_distance

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["Bias", "NoisyMoments", "algebraic_rows", "bias_by_noise", "distance_rows", "moments_of"]

_STEP = 0.25
"""Step of the differences, in standard deviations of the noise: small beside what the rows curve over, and their
rounding is 16 times that of the moments."""


class NoisyMoments(NamedTuple):
    """Weighted means of the products of rows, and the part of them that noise has lent, each (B, k, k)."""

    found: Float[Tensor, "B k k"]
    lent: Float[Tensor, "B k k"]


class Bias(NamedTuple):
    """Of the parameters (B, p), and the matrix (B, p, p) that their errors grow by without what the noise has lent."""

    offset: Float[Tensor, "B p"]
    growth: Float[Tensor, "B p p"]


def moments_of(
    rows: Callable[[Float[Tensor, "B N 3"]], Float[Tensor, "B N k"]],
    points: Float[Tensor, "B N 3"],
    weight: Float[Tensor, "B N"],
    noise: Float[Tensor, " B"],
) -> NoisyMoments:
    """Moments of rows that are made of points.

    Args:
        rows: of each point.
        points: with their noise.
        weight: of each point, not all 0.
        noise: standard deviation of each component of the points, in their unit.

    Example:
        >>> points = torch.zeros(1, 1, 3).double()
        >>> square = lambda p: torch.stack([p[..., 0], torch.ones_like(p[..., 0])], -1)
        >>> moments_of(square, points, torch.ones(1, 1).double(), torch.tensor([2.0]).double()).lent
        tensor([[[4., 0.],
                 [0., 0.]]], dtype=torch.float64)
    """
    share = weight / weight.sum(-1, keepdim=True)

    def at(where: Tensor) -> Tensor:
        row = rows(where)
        return torch.einsum("bn,bni,bnj->bij", share, row, row)

    found = at(points)
    lent = torch.zeros_like(found)
    for axis in torch.eye(3, dtype=points.dtype, device=points.device):
        aside = (_STEP * noise)[:, None, None] * axis
        lent = lent + (at(points + aside) - found) + (at(points - aside) - found)
    return NoisyMoments(found, lent / (2.0 * _STEP**2))


def bias_by_noise(moments: NoisyMoments) -> Bias:
    """Of parameters at which the rows' mean product with the residual, their last element, is 0.

    Args:
        moments: of rows of the residual's derivatives by the parameters and of the residual.
    """
    p = moments.found.shape[-1] - 1
    without = (moments.found - moments.lent)[:, :p, :p]
    right = torch.cat([moments.found[:, :p, :p], -moments.lent[:, :p, p:]], -1)
    solution, _ = torch.linalg.solve_ex(without, right)
    return Bias(solution[..., p], solution[..., :p])


def algebraic_rows(coef: Float[Tensor, "B 9"]) -> Callable[[Float[Tensor, "B N 3"]], Float[Tensor, "B N 10"]]:
    """Derivatives of the algebraic residual, ``1 - coef · monomials``, less their sign, and the residual's negative."""

    def rows(points: Tensor) -> Tensor:
        regressors = monomials(points)
        return torch.cat([regressors, torch.einsum("bni,bi->bn", regressors, coef).unsqueeze(-1) - 1.0], -1)

    return rows


def distance_rows(theta: Float[Tensor, "B 9"]) -> Callable[[Float[Tensor, "B N 3"]], Float[Tensor, "B N 10"]]:
    """Derivatives of :func:`sampson_distance` by its parameters, and the distance."""
    of_one = torch.func.vmap(torch.func.jacfwd(sampson_distance), in_dims=(0, 0))
    distance = torch.func.vmap(sampson_distance)

    def rows(points: Tensor) -> Tensor:
        return torch.cat([of_one(theta, points), distance(theta, points).unsqueeze(-1)], -1)

    return rows
