"""The objective and its quadratic model at a point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.small_factors import symmetric_eigenvalues
from mkc_torch.density.energy import energy_value
from mkc_torch.nonlinear._problem import TRUST, Problem, ProblemPoint

if TYPE_CHECKING:
    from jaxtyping import Float


@dataclass(frozen=True)
class Penalty:
    """Augmented Lagrangian ``½ ρ (c + u/ρ)²``, clipped at 0 for inequalities; multipliers and ρ are (B, k)."""

    multiplier: Tensor
    rho: Tensor

    def excess(self, problem: Problem, constraint: Tensor) -> Tensor:
        shifted = constraint + self.multiplier / self.rho
        assert problem.is_inequality is not None
        return torch.where(problem.is_inequality, shifted.clamp(max=0.0), shifted)


@dataclass(frozen=True)
class _Quadratic:
    """Quadratic model of the objective: value (B,), gradient (B, p) and two curvatures (B, p, p)."""

    value: Tensor
    gradient: Tensor
    curvature: Tensor
    majoriser: Tensor


def prior_value(problem: Problem, theta: Tensor) -> Tensor:
    if problem.prior_mean is None or problem.prior_precision is None:
        return torch.zeros_like(theta[:, 0])
    away = theta - problem.prior_mean
    return 0.5 * (away * (away @ problem.prior_precision)).sum(-1)


def objective(
    problem: Problem,
    theta: Tensor,
    residual: Tensor,
    constraint: Tensor | None,
    kappa: Tensor,
    d: Tensor,
    penalty: Penalty | None,
) -> Float[Tensor, " B"]:
    energies = energy_value(residual / d.unsqueeze(-2), kappa.unsqueeze(-2))
    value = (energies if problem.weight is None else problem.weight * energies).sum((-2, -1))
    value = value + prior_value(problem, theta)
    if penalty is not None and constraint is not None:
        value = value + 0.5 * (penalty.rho * penalty.excess(problem, constraint).square()).sum(-1)
    return value


def _gram(tangents: Float[Tensor, "B p K"], weight: Float[Tensor, "B K"]) -> Float[Tensor, "B p p"]:
    return torch.matmul(tangents * weight.unsqueeze(-2), tangents.mT)


def quadratic_about(
    problem: Problem,
    point: ProblemPoint,
    kappa: Tensor,
    d: Tensor,
    penalty: Penalty | None,
    value: Tensor | None = None,
) -> _Quadratic:
    """Gradient and curvatures of the objective: of its majoriser with weights w, and its own with w (1 - κ z²)."""
    k = kappa.unsqueeze(-2)
    precision = d.pow(-2).unsqueeze(-2)
    x = point.residual.square() * (precision * k)
    w = torch.exp(-0.5 * x) * precision
    if problem.weight is not None:
        w = w * problem.weight
    T = point.tangents
    gradient = torch.matmul(T, (w * point.residual).flatten(1).unsqueeze(-1)).squeeze(-1)
    majoriser = _gram(T, w.flatten(1))
    lowered = torch.zeros_like(majoriser) if not bool(kappa.any()) else _gram(T, (w * x).flatten(1))
    if problem.prior_mean is not None and problem.prior_precision is not None:
        gradient = gradient + (point.theta - problem.prior_mean) @ problem.prior_precision
        majoriser = majoriser + problem.prior_precision
    if penalty is not None and point.constraint is not None and point.normals is not None:
        excess = penalty.rho * penalty.excess(problem, point.constraint)
        assert problem.is_inequality is not None
        stiffness = torch.where(problem.is_inequality & (excess >= 0), 0.0, penalty.rho)
        gradient = gradient + torch.matmul(excess.unsqueeze(-2), point.normals).squeeze(-2)
        majoriser = majoriser + torch.matmul(point.normals.mT * stiffness.unsqueeze(-2), point.normals)
    if value is None:
        value = objective(problem, point.theta, point.residual, point.constraint, kappa, d, penalty)
    return _Quadratic(value, gradient, majoriser - lowered, majoriser)


def model_curvature(quadratic: _Quadratic) -> Tensor:
    """Curvature of the objective where it is safely positive, else that of the majoriser."""
    majoriser = quadratic.majoriser
    scale = positive(majoriser.diagonal(dim1=-2, dim2=-1)).rsqrt()
    scaled = majoriser * scale.unsqueeze(-1) * scale.unsqueeze(-2)
    eps = torch.finfo(scale.dtype).eps
    eye = torch.eye(scale.shape[-1], dtype=scale.dtype, device=scale.device)
    factor, failed = torch.linalg.cholesky_ex(scaled + 100 * eps * eye)
    own = quadratic.curvature * scale.unsqueeze(-1) * scale.unsqueeze(-2)
    half = torch.linalg.solve_triangular(factor, own, upper=False)
    share = torch.linalg.solve_triangular(factor, half.mT, upper=False).nan_to_num(0.0, 0.0, 0.0)
    least = symmetric_eigenvalues(0.5 * (share + share.mT))[..., 0]
    trusted = (failed == 0) & (least > TRUST)
    return torch.where(trusted[:, None, None], quadratic.curvature, majoriser)


def positive(diagonal: Tensor) -> Tensor:
    """Marquardt's scaling; a parameter without effect gets 1."""
    return torch.where(diagonal > 0, diagonal, 1.0)
