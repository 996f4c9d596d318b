"""Means, covariances and Mahalanobis distances of points."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


def moments_of(
    points: Float[Tensor, "B N p"], counts: Bool[Tensor, "B N"], centre: Float[Tensor, "B p"]
) -> tuple[Float[Tensor, "B p"], Float[Tensor, "B p p"]]:
    """Mean and covariance, with divisor k - 1, of the k points of a mask; differentiable in the points.

    Args:
        points: the sample.
        counts: mask of the points (True: used).
        centre: subtracted before summation, so that a large mean loses no digits.
    """
    number = counts.sum(-1, keepdim=True).to(points.dtype)
    counts = counts.unsqueeze(-1)
    # masked points are zeroed before squaring
    error = torch.where(counts, points - centre.unsqueeze(-2), 0.0)
    shift = error.sum(-2) / number
    error = torch.where(counts, error - shift.unsqueeze(-2), 0.0)
    covariance = torch.matmul(error.mT, error) / (number - 1.0).unsqueeze(-1)
    return centre + shift, covariance


def correlation(covariance: Float[Tensor, "*B p p"]) -> Float[Tensor, "*B p p"]:
    """Correlations of a covariance of positive variances; the diagonal is 1."""
    deviation = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    ratio = covariance / deviation.unsqueeze(-1) / deviation.unsqueeze(-2)
    eye = torch.eye(covariance.shape[-1], dtype=torch.bool, device=covariance.device)
    return torch.where(eye, 1.0, ratio)


def mahalanobis_distance(
    points: Float[Tensor, "*B N p"], location: Float[Tensor, "*B p"], covariance: Float[Tensor, "*B p p"]
) -> Float[Tensor, "*B N"]:
    """``sqrt((x - t)ᵀ C⁻¹ (x - t))`` of every point, for a positive definite covariance."""
    deviation = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    error = (points - location.unsqueeze(-2)) / deviation.unsqueeze(-2)
    factor = torch.linalg.cholesky(correlation(covariance))
    white = torch.linalg.solve_triangular(factor, error.mT, upper=False)
    return torch.linalg.vector_norm(white, dim=-2)
