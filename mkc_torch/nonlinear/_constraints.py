"""Equalities and inequalities by an augmented Lagrangian: descents with updated multipliers."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from mkc_torch.nonlinear._descent import Descent, descend
from mkc_torch.nonlinear._problem import Problem, ProblemPoint
from mkc_torch.nonlinear._quadratic import Penalty, positive, quadratic_about

_MULTIPLIERS = 30
"""Largest number of updates of the multipliers."""

_STIFFNESS = 100.0
"""Curvature of the penalty over that of the objective along a constraint; each update gains about this factor."""


def descend_constrained(
    problem: Problem,
    point: ProblemPoint,
    kappa: Tensor,
    d: Tensor,
    *,
    max_iter: int,
    tol: float,
    penalty: Penalty | None = None,
    damping: Tensor | None = None,
    allowance: Tensor | None = None,
    exact: bool = True,
) -> tuple[Descent, Penalty | None]:
    """Descend, and repeat with updated multipliers until the constraints hold."""
    if penalty is None and problem.is_inequality is not None:
        penalty = _first_penalty(problem, problem.refreshed(point), kappa, d)
    if penalty is None:
        found = descend(
            problem,
            point,
            kappa,
            d,
            None,
            max_iter=max_iter,
            tol=tol,
            damping=damping,
            allowance=allowance,
            exact=exact,
        )
        return found, None
    n_iter = 0
    strict = 1e-9 if point.theta.dtype == torch.float64 else 1e-5
    holds = torch.zeros_like(point.theta[:, 0], dtype=torch.bool)
    previous: Tensor | None = None
    for outer in range(_MULTIPLIERS):
        found = descend(
            problem,
            problem.refreshed(point),
            kappa,
            d,
            penalty,
            max_iter=max_iter,
            tol=max(tol, 10.0 ** (-3 - 2 * outer)),
            allowance=allowance,
        )
        n_iter += found.n_iter
        point = found.point
        assert point.constraint is not None
        assert point.normals is not None
        assert problem.is_inequality is not None
        multiplier = penalty.rho * penalty.excess(problem, point.constraint)
        # a constraint has converged when it holds and, for an inequality with slack, its multiplier is 0
        off = torch.where(
            problem.is_inequality,
            torch.maximum(point.constraint, multiplier / penalty.rho).abs(),
            point.constraint.abs(),
        )
        off = torch.where(problem.is_inequality & (multiplier == 0), (-point.constraint).clamp(min=0.0), off)
        size = 1.0 + (point.normals.abs() * point.theta.abs().unsqueeze(-2)).sum(-1)
        holds = (off <= strict * size).all(-1)
        rho = penalty.rho
        if previous is not None:
            rho = torch.where(off > 0.25 * previous, 10.0 * rho, rho)
        stiff = _first_penalty(problem, point, kappa, d)
        assert stiff is not None
        rho = torch.maximum(rho, stiff.rho)
        if bool((holds & found.converged).all()) and 10.0 ** (-3 - 2 * outer) <= max(tol, 1e-9):
            break
        previous = off
        penalty = Penalty(multiplier, rho)
    return replace(found, n_iter=n_iter, converged=found.converged & holds), penalty


def _first_penalty(problem: Problem, point: ProblemPoint, kappa: Tensor, d: Tensor) -> Penalty | None:
    """Multipliers 0, and a ρ that is stiff compared to the objective along each constraint."""
    if point.constraint is None or point.normals is None:
        return None
    majoriser = quadratic_about(problem, point, kappa, d, None).majoriser
    scale = positive(majoriser.diagonal(dim1=-2, dim2=-1)).rsqrt()
    scaled = majoriser * scale.unsqueeze(-1) * scale.unsqueeze(-2)
    eye = torch.eye(scale.shape[-1], dtype=scale.dtype, device=scale.device)
    normals = point.normals * scale.unsqueeze(-2)
    compliance = (normals * torch.linalg.solve(scaled + 1e-6 * eye, normals.mT).mT).sum(-1)
    rho = _STIFFNESS / torch.where(compliance > 0, compliance, 1.0)
    return Penalty(torch.zeros_like(rho), rho)
