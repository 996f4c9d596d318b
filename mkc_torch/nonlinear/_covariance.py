"""Covariance of the parameters, within active bounds and constraints."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.small_factors import pinv, symmetric_eigen, symmetric_pinv
from mkc_torch.linear.covariance import CovarianceKind, sandwich
from mkc_torch.nonlinear._problem import Problem, ProblemPoint, kernel_weights
from mkc_torch.nonlinear._quadratic import Penalty, positive, quadratic_about

if TYPE_CHECKING:
    from jaxtyping import Float


def parameter_covariance(
    problem: Problem,
    point: ProblemPoint,
    kappa: Tensor,
    d: Tensor,
    penalty: Penalty | None,
    kind: CovarianceKind,
    bandwidth: float | None,
) -> Float[Tensor, "B p p"]:
    """Sandwich covariance, computed with columns scaled to norm 1, within the active bounds and constraints."""
    quadratic = quadratic_about(problem, point, kappa, d, None)
    size = positive(quadratic.majoriser.diagonal(dim1=-2, dim2=-1)).rsqrt()
    curvature = quadratic.curvature * size.unsqueeze(-1) * size.unsqueeze(-2)
    eye = torch.eye(size.shape[-1], dtype=size.dtype, device=size.device)
    held = _active_normals(problem, point, quadratic.gradient, penalty) * size.unsqueeze(-2)
    length = torch.linalg.vector_norm(held, dim=-1, keepdim=True)
    held = held / positive(length)
    free = eye - torch.matmul(pinv(held), held)
    curvature = free @ curvature @ free + (eye - free)
    values, vectors = symmetric_eigen(curvature)
    eps = torch.finfo(size.dtype).eps
    blind = values.abs() <= 1e3 * eps * values.abs().amax(-1, keepdim=True)
    unknown = (vectors.square() * blind.unsqueeze(-2)).sum(-1) > 1e-6

    precision = d.pow(-2).unsqueeze(-2)
    psi = kernel_weights(point.residual, kappa, d) * point.residual * precision
    if problem.weight is not None:
        psi = psi * problem.weight
    score = (point.tangents.unflatten(-1, psi.shape[1:]) * psi.unsqueeze(1)).sum(-1).mT
    score = torch.matmul(score * size.unsqueeze(-2), free)
    total = float(psi[0].numel())
    used = torch.full_like(size[:, 0], total) if problem.used is None else problem.used.sum((-2, -1)).to(size)
    left = used - free.diagonal(dim1=-2, dim2=-1).sum(-1).round()
    covariance = sandwich(curvature, score, used / left.clamp(min=1.0), kind, bandwidth)
    if problem.prior_precision is not None:
        # the prior is a further measurement with its own precision
        inverse = symmetric_pinv(curvature) @ free
        extra = problem.prior_precision * size.unsqueeze(-1) * size.unsqueeze(-2)
        covariance = covariance + inverse @ extra @ inverse.mT
    covariance = free @ covariance @ free * size.unsqueeze(-1) * size.unsqueeze(-2)
    no_errors = (left <= 0) if problem.prior_precision is None else torch.zeros_like(left, dtype=torch.bool)
    lost = unknown | no_errors.unsqueeze(-1)
    return torch.where(lost.unsqueeze(-1) | lost.unsqueeze(-2), torch.inf, covariance)


def _active_normals(problem: Problem, point: ProblemPoint, gradient: Tensor, penalty: Penalty | None) -> Tensor:
    """Normals (B, k, p) of the active bounds and constraints; 0 for inactive bounds and constraints."""
    B, p = point.theta.shape
    rows = [torch.zeros(B, 1, p, dtype=gradient.dtype, device=gradient.device)]
    if problem.box is not None:
        at = (point.theta <= problem.box[0]) | (point.theta >= problem.box[1])
        rows.append(torch.diag_embed(at.to(gradient.dtype)))
    if penalty is not None and point.constraint is not None and point.normals is not None:
        assert problem.is_inequality is not None
        active = ~problem.is_inequality | (penalty.rho * penalty.excess(problem, point.constraint) < 0)
        rows.append(point.normals * active.to(gradient.dtype).unsqueeze(-1))
    return torch.cat(rows, -2)
