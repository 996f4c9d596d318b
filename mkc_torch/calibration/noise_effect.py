"""Effect of noise in the points on an ellipsoid fit: bias, and spurious information.

Regressors of noisy points contain the square of the noise. It biases the parameters, and gives points that do not
determine an ellipsoid, for example on two circles, a spurious curvature. To second order both effects are half the
variance of the noise times the Laplacian of the moments with respect to the points; subtracting this product gives the
moments of the points without noise (Kukush, Markovsky & Van Huffel, "Consistent estimation in an implicit quadratic
measurement error model", Computational Statistics & Data Analysis 47 (2004)). The noise is assumed to be isotropic.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch._support.small_factors import solve
from mkc_torch.calibration.ellipsoid import monomials, sampson_distance

if TYPE_CHECKING:
    from jaxtyping import Float

_STEP = 0.25
"""Step of the finite differences, in standard deviations of the noise: small compared with the curvature of the rows;
the rounding error is 16 times that of the moments."""


class NoisyMoments(NamedTuple):
    """Weighted means of the products of rows, and the part of them that is due to noise, each (B, k, k)."""

    found: Float[Tensor, "B k k"]
    lent: Float[Tensor, "B k k"]


class Bias(NamedTuple):
    """Bias of the parameters (B, p), and the factor (B, p, p) by which their errors grow without the noise's part."""

    offset: Float[Tensor, "B p"]
    growth: Float[Tensor, "B p p"]


def moments_of(
    rows: Callable[[Float[Tensor, "B N 3"]], Float[Tensor, "B N k"]],
    points: Float[Tensor, "B N 3"],
    weight: Float[Tensor, "B N"],
    noise: Float[Tensor, " B"],
) -> NoisyMoments:
    """Moments of rows that depend on noisy points.

    Args:
        rows: computes the rows (B, N, k) of points.
        points: the noisy points.
        weight: weight of each point, not all 0.
        noise: standard deviation of each component of the points, in their unit, (B,).

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
        shift = (_STEP * noise)[:, None, None] * axis
        lent = lent + (at(points + shift) - found) + (at(points - shift) - found)
    return NoisyMoments(found, lent / (2.0 * _STEP**2))


def bias_by_noise(moments: NoisyMoments) -> Bias:
    """Bias of parameters at which the mean product of the rows with the residual, their last element, is 0.

    Args:
        moments: moments of rows that hold the residual's derivatives with respect to the parameters and the residual.
    """
    p = moments.found.shape[-1] - 1
    without = (moments.found - moments.lent)[:, :p, :p]
    right = torch.cat([moments.found[:, :p, :p], -moments.lent[:, :p, p:]], -1)
    solution = solve(without, right)
    return Bias(solution[..., p], solution[..., :p])


def algebraic_rows(coef: Float[Tensor, "B 9"]) -> Callable[[Float[Tensor, "B N 3"]], Float[Tensor, "B N 10"]]:
    """Negative derivatives of the algebraic residual, ``1 - coef · monomials``, and its negative."""

    def rows(points: Tensor) -> Tensor:
        regressors = monomials(points)
        return torch.cat([regressors, torch.einsum("bni,bi->bn", regressors, coef).unsqueeze(-1) - 1.0], -1)

    return rows


def distance_rows(theta: Float[Tensor, "B 9"]) -> Callable[[Float[Tensor, "B N 3"]], Float[Tensor, "B N 10"]]:
    """Derivatives of :func:`sampson_distance` by its parameters, and the distance."""
    derivatives = torch.func.vmap(torch.func.jacfwd(sampson_distance), in_dims=(0, 0))
    distance = torch.func.vmap(sampson_distance)

    def rows(points: Tensor) -> Tensor:
        return torch.cat([derivatives(theta, points), distance(theta, points).unsqueeze(-1)], -1)

    return rows
