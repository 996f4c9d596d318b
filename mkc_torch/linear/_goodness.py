"""Robust coefficient of determination."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.linear._influence import weighted

if TYPE_CHECKING:
    from jaxtyping import Float

    from mkc_torch.linear._problem import LinearProblem


def robust_r_squared(
    problem: LinearProblem, beta: Float[Tensor, "B n"], weight: Float[Tensor, "B N m"], ratio: float
) -> Float[Tensor, "B m"]:
    """Share of the weighted spread that the fit explains, consistent for Gaussian errors.

    ``(S - R) / (S + R (a - 1))``: S is the weighted sum of squares about the weighted mean (about 0 where the columns
    contain no constant), R that of the residuals, and a, ``ratio``, is
    ``E w / E w z²`` for Gaussian errors: 1 for equal weights, 1.2076 for the bisquare at 95 % efficiency.

    Renaud & Victoria-Feser, "A robust coefficient of determination for regression", Journal of Statistical Planning and
    Inference 140 (2010) 1852-1862, the version with the correction for consistency.
    """
    w = weighted(problem, weight)
    total = w.sum(-2, keepdim=True).clamp(min=torch.finfo(w.dtype).tiny)
    centre = torch.where(_holds_constant(problem)[:, None, :], (w * problem.Y).sum(-2, keepdim=True) / total, 0.0)
    spread = (w * (problem.Y - centre).square()).sum(-2)
    left = (w * problem.residual(beta).square()).sum(-2)
    whole = spread + left * (ratio - 1.0)
    return torch.where(whole > 0, (spread - left) / torch.where(whole > 0, whole, 1.0), 1.0)


def _holds_constant(problem: LinearProblem) -> Tensor:
    """Whether a combination of the columns is 1 in a channel's rows and 0 in the other channels', (B or 1, m)."""
    N, m = problem.num_samples, problem.num_channels
    constant = torch.eye(m, dtype=problem.Y.dtype, device=problem.Y.device).expand(N, m, m).flatten(0, 1)
    rows = problem.basis.detach().flatten(-3, -2)
    if problem.sample_weight is not None and rows.shape[0] == problem.Y.shape[0]:
        used = (problem.sample_weight > 0).flatten(-2).unsqueeze(-1)
        rows, constant = rows * used, constant * used
    left = constant - torch.matmul(rows, torch.matmul(rows.mT, constant))
    tolerance = math.sqrt(torch.finfo(rows.dtype).eps)
    return torch.linalg.vector_norm(left, dim=-2) <= tolerance * torch.linalg.vector_norm(constant, dim=-2)
