"""Levenberg-Marquardt on one objective: damped steps within a box."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.nonlinear._problem import NONLINEAR, Descent, Problem, ProblemPoint
from mkc_torch.nonlinear._quadratic import Penalty, model_curvature, objective, positive, quadratic_about
from mkc_torch.nonlinear._single_problem import descend_single, is_single

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["Descent", "damped_step", "descend", "within"]


def within(box: tuple[Tensor, Tensor] | None, theta: Tensor) -> Tensor:
    return theta if box is None else torch.minimum(torch.maximum(theta, box[0]), box[1])


def damped_step(
    problem: Problem, theta: Tensor, gradient: Tensor, model: Tensor, scaling: Tensor, damping: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Damped step within the box, its predicted decrease, and whether the linear system could be solved."""
    damped = model + torch.diag_embed(damping.unsqueeze(-1) * scaling)
    held = torch.zeros_like(theta, dtype=torch.bool)
    step = torch.zeros_like(theta)
    if problem.box is not None:
        lower, upper = problem.box
        held = ((theta <= lower) & (gradient > 0)) | ((theta >= upper) & (gradient < 0))
    solved = torch.ones_like(damping, dtype=torch.bool)
    for _ in range(theta.shape[-1] + 1):
        linear_term = gradient + torch.matmul(damped, torch.where(held, step, 0.0).unsqueeze(-1)).squeeze(-1)
        coupled = held.unsqueeze(-1) | held.unsqueeze(-2)
        matrix = torch.where(coupled, 0.0, damped) + torch.diag_embed(torch.where(held, positive(scaling), 0.0))
        factor, failed = torch.linalg.cholesky_ex(matrix)
        solved = failed == 0
        free = torch.cholesky_solve(torch.where(held, 0.0, -linear_term).unsqueeze(-1), factor).squeeze(-1)
        step = torch.where(held, step, free)
        if problem.box is None:
            break
        beyond = ~held & ((theta + step < lower) | (theta + step > upper))
        step = torch.where(beyond, within(problem.box, theta + step) - theta, step)
        # a parameter that reaches its bound stays there while the others are solved for again
        if not bool(beyond.any()):
            break
        held = held | beyond
    predicted = -(gradient * step).sum(-1) - 0.5 * (step * torch.matmul(model, step.unsqueeze(-1)).squeeze(-1)).sum(-1)
    return step, predicted, solved & torch.isfinite(step).all(-1)


def descend(
    problem: Problem,
    point: ProblemPoint,
    kappa: Tensor,
    d: Tensor,
    penalty: Penalty | None,
    *,
    max_iter: int,
    tol: float,
    allowance: Tensor | None = None,
    damping: Tensor | None = None,
    exact: bool = True,
) -> Descent:
    """Levenberg-Marquardt on the objective at fixed σ, d and penalty; the objective never rises.

    A problem has converged when a step with little damping has a predicted and an actual decrease of at most ``tol`` of
    the objective, or of ``allowance``. Without ``exact``, derivatives of a nearby point suffice for that.
    """
    if penalty is None and is_single(problem, point):
        return descend_single(
            problem, point, kappa, d, max_iter=max_iter, tol=tol, allowance=allowance, damping=damping, exact=exact
        )
    eps = torch.finfo(point.theta.dtype).eps
    quadratic = quadratic_about(problem, point, kappa, d, penalty)
    model = model_curvature(quadratic)
    scaling = positive(quadratic.majoriser.diagonal(dim1=-2, dim2=-1))
    if damping is None:
        damping = torch.full_like(quadratic.value, 1e-4)
    growth = torch.full_like(damping, 4.0)
    done = torch.zeros_like(damping, dtype=torch.bool)
    least = eps * eps * quadratic.value
    if allowance is not None:
        least = torch.maximum(least, allowance)
    n_iter, needs_refresh = 0, False
    while n_iter < max_iter and not bool(done.all()):
        if needs_refresh:
            point = problem.refreshed(point)
            quadratic = quadratic_about(problem, point, kappa, d, penalty, quadratic.value)
            model = model_curvature(quadratic)
            scaling = positive(torch.maximum(quadratic.majoriser.diagonal(dim1=-2, dim2=-1), 1e-6 * scaling))
        n_iter += 1
        step, predicted, solved = damped_step(problem, point.theta, quadratic.gradient, model, scaling, damping)
        theta = within(problem.box, point.theta + step)
        residual, constraint = problem.residual(theta), problem.constraints(theta)
        value = objective(problem, theta, residual, constraint, kappa, d, penalty)
        actual = quadratic.value - value
        limit = torch.maximum(max(tol, 16 * eps) * quadratic.value, least)
        # a step that bounds cut off may increase the model
        solved = solved & (predicted >= -limit)
        accept = solved & (actual > 0) & ~done
        small = solved & (damping <= 1.0) & (predicted <= limit) & ~(actual > limit)
        small = small | (solved & (step.abs() <= 4 * eps * point.theta.abs()).all(-1))
        ratio = (actual / predicted.clamp(min=torch.finfo(actual.dtype).tiny)).clamp(max=2.0)
        shrink = (1.0 - (2.0 * ratio - 1.0).pow(3)).clamp(0.1, 2.0)
        failed_step = ~accept & ~small & ~done
        # a failed step with stale derivatives does not raise the damping
        changed = torch.where(
            accept, damping * shrink, torch.where(failed_step & (not point.stale), damping * growth, damping)
        )
        growth = torch.where(accept, 4.0, torch.where(failed_step, 2.0 * growth, growth))
        damping = torch.where(done, damping, changed.clamp(100 * eps, 1e16))
        unpredicted = _unpredicted_share(point, step, residual, constraint) > NONLINEAR
        must_refresh = point.stale and exact
        needs_refresh = bool((unpredicted & accept & ~small).any()) or bool(
            (small & must_refresh | failed_step & point.stale).any()
        )
        done = done | (small & (not must_refresh))
        if bool(accept.any()):
            moved = bool((accept & ~small).any())
            point = replace(point.moved(accept, theta, residual, constraint), stale=moved or point.stale)
            current = torch.where(accept, value, quadratic.value)
            if n_iter < max_iter and not bool(done.all()) and not needs_refresh:
                quadratic = quadratic_about(problem, point, kappa, d, penalty, current)
                model = model_curvature(quadratic)
            else:
                quadratic = replace(quadratic, value=current)
        elif bool((done | (damping >= 1e15)).all()):
            break
    return Descent(point, quadratic.value, done, needs_refresh, damping, n_iter)


def _unpredicted_share(
    point: ProblemPoint, step: Tensor, residual: Tensor, constraint: Tensor | None
) -> Float[Tensor, " B"]:
    """Share of a step's effect on residuals and constraints that the derivatives did not predict."""
    linear = torch.matmul(step.unsqueeze(-2), point.tangents).squeeze(-2)
    change = (residual - point.residual).flatten(1)
    error = (change - linear).square().sum(-1) / linear.square().sum(-1)
    if constraint is not None and point.constraint is not None and point.normals is not None:
        linear = torch.matmul(point.normals, step.unsqueeze(-1)).squeeze(-1)
        off = (constraint - point.constraint - linear).square().sum(-1) / linear.square().sum(-1)
        error = torch.maximum(error, off)
    return error.sqrt().nan_to_num(0.0, torch.inf)
