"""What the fixed point and MKC-EM share: weights, objective and covariance of coefficients under the MKC likelihood."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.functional import energy
from mkc_torch.linear._scale_search import relative_precision
from mkc_torch.linear.covariance import CovarianceKind, sandwich

if TYPE_CHECKING:
    from jaxtyping import Float

    from mkc_torch.linear._problem import LinearProblem


def kernel_weight(
    residual: Float[Tensor, "B *S N m"], kappa: Float[Tensor, "B *S m"], d: Float[Tensor, "B *S m"]
) -> Float[Tensor, "B *S N m"]:
    """``exp(-κ z² / 2)`` with z = e / d, the diagonal of W_k in (14) of the paper."""
    rate = (-0.5 * kappa / d.square()).unsqueeze(-2)
    return torch.exp(rate * residual.square())


def fixed_point_step(problem: LinearProblem, residual: Tensor, kappa: Tensor, d: Tensor) -> Float[Tensor, "B *S n"]:
    """One application of (15) of the paper."""
    return problem.weighted_fit(kernel_weight(residual, kappa, d) * relative_precision(d).unsqueeze(-2))


def mean_energy(problem: LinearProblem, residual: Tensor, kappa: Tensor, d: Tensor) -> Float[Tensor, B * S]:
    """The MKC loss (9): the mean energy over the samples, summed over the channels."""
    e = energy(residual / d.unsqueeze(-2), kappa.unsqueeze(-2))
    if problem.sample_weight is None:
        return e.mean(-2).sum(-1)
    weight = problem.sample_weight if e.dim() == 3 else problem.sample_weight.unsqueeze(1)
    return ((weight * e).sum(-2) / weight.sum(-2)).sum(-1)


def coefficient_covariance(
    problem: LinearProblem,
    beta: Float[Tensor, "B n"],
    kappa: Float[Tensor, "B m"],
    d: Float[Tensor, "B m"],
    kind: CovarianceKind,
    bandwidth: float | None,
) -> Float[Tensor, "*batch n n"]:
    """Sandwich covariance of the user's coefficients; the curvature is that of the objective, not of its surrogate."""
    residual = problem.residual(beta)
    z2 = (residual / d.unsqueeze(-2)).square()
    k = kappa.unsqueeze(-2)
    w = torch.exp(-0.5 * k * z2)
    precision = d.pow(-2).unsqueeze(-2)
    curvature, _ = problem.normal_equations(w * (1.0 - k * z2) * precision)
    psi = w * residual * precision
    if problem.sample_weight is not None:
        psi = psi * problem.sample_weight
    score = torch.matmul(psi.unsqueeze(-2), problem.basis).squeeze(-2)
    used = (
        problem.total_weight().sum(-1) if problem.sample_weight is None else (problem.sample_weight > 0).sum((-2, -1))
    )
    dof = used / (used - problem.num_coefficients).clamp(min=1)
    in_basis = sandwich(curvature, score, dof.to(score.dtype), kind, bandwidth)
    return problem.restore(torch.matmul(torch.matmul(problem.to_coef, in_basis), problem.to_coef.mT))
