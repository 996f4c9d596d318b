"""The descent for a single problem without constraints, in NumPy, since torch's overhead exceeds its few operations."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mkc_torch.nonlinear._problem import NONLINEAR, TRUST, Descent, Problem, ProblemPoint

Array = NDArray[np.float64]


def is_single(problem: Problem, point: ProblemPoint) -> bool:
    """Whether this is a single problem, without constraints, in float64 on the CPU."""
    theta = point.theta
    return (
        len(theta) == 1
        and problem.is_inequality is None
        and theta.dtype == torch.float64
        and theta.device.type == "cpu"
        and not point.residual.requires_grad
    )


def descend_single(
    problem: Problem,
    point: ProblemPoint,
    kappa: Tensor,
    d: Tensor,
    *,
    max_iter: int,
    tol: float,
    allowance: Tensor | None,
    damping: Tensor | None,
    exact: bool,
) -> Descent:
    """As :func:`mkc_torch.nonlinear._descent.descend`, for a single problem without constraints, step for step."""
    eps = float(np.finfo(float).eps)
    objective, at = _Objective(problem, kappa, d), _Point.of(point)
    with np.errstate(all="ignore"):
        quadratic = objective.quadratic(at.theta, at.residual, at.tangents, None)
        model, scaling = _model_curvature(quadratic), _positive(quadratic.majoriser.diagonal())
        own, growth = 1e-4 if damping is None else float(damping[0]), 4.0
        done = needs_refresh = False
        least = eps * eps * quadratic.value
        if allowance is not None:
            least = max(least, float(allowance[0]))
        n_iter = 0
        while n_iter < max_iter and not done:
            if needs_refresh:
                point = problem.refreshed(point)
                at = _Point.of(point)
                quadratic = objective.quadratic(at.theta, at.residual, at.tangents, quadratic.value)
                model = _model_curvature(quadratic)
                scaling = _positive(np.maximum(quadratic.majoriser.diagonal(), 1e-6 * scaling))
            n_iter += 1
            step, predicted, solved = _damped_step(objective.box, at.theta, quadratic, model, scaling, own)
            theta = _within(objective.box, at.theta + step)
            there = torch.from_numpy(theta).unsqueeze(0)
            residual = problem.residual(there)
            after = residual[0].detach().numpy()
            value = objective.value(theta, after)
            actual = quadratic.value - value
            limit = max(max(tol, 16 * eps) * quadratic.value, least)
            # a step that bounds cut off may increase the model
            solved = solved and predicted >= -limit
            accept = solved and actual > 0
            small = solved and own <= 1.0 and predicted <= limit and not actual > limit
            small = small or (solved and bool((np.abs(step) <= 4 * eps * np.abs(at.theta)).all()))
            ratio = min(actual / max(predicted, np.finfo(float).tiny), 2.0)
            if accept:
                own, growth = own * min(max(1.0 - (2.0 * ratio - 1.0) ** 3, 0.1), 2.0), 4.0
            elif not small:
                # a failed step with stale derivatives does not raise the damping
                own, growth = own if point.stale else own * growth, 2.0 * growth
            own = min(max(own, 100 * eps), 1e16)
            unpredicted = _unpredicted_share(at, step, after) > NONLINEAR
            must_refresh = point.stale and exact
            needs_refresh = bool((unpredicted and accept and not small) or (small and must_refresh))
            needs_refresh = needs_refresh or (point.stale and not accept and not small)
            done = small and not must_refresh
            if accept:
                stale = point.stale or not small
                point = replace(point, theta=there, residual=residual, stale=stale)
                at = _Point(theta, after, at.tangents)
                if n_iter < max_iter and not done and not needs_refresh:
                    quadratic = objective.quadratic(theta, after, at.tangents, value)
                    model = _model_curvature(quadratic)
                else:
                    quadratic = replace(quadratic, value=value)
            elif done or own >= 1e15:
                break
    like = point.theta[:, 0]
    return Descent(
        point,
        torch.full_like(like, quadratic.value),
        torch.full_like(like, done, dtype=torch.bool),
        needs_refresh,
        torch.full_like(like, own),
        n_iter,
    )


@dataclass(frozen=True)
class _Point:
    """Parameters (p,) with their residual (N, m) and tangents (p, N m)."""

    theta: Array
    residual: Array
    tangents: Array

    @classmethod
    def of(cls, point: ProblemPoint) -> _Point:
        return cls(point.theta[0].numpy(), point.residual[0].numpy(), point.tangents[0].numpy())


def _unpredicted_share(at: _Point, step: Array, after: Array) -> float:
    """Share of a step's effect on the residuals that the derivatives did not predict."""
    linear = step @ at.tangents
    off = np.square((after - at.residual).reshape(-1) - linear).sum() / np.square(linear).sum()
    return 0.0 if np.isnan(off) else float(np.sqrt(off))


def _within(box: tuple[Array, ...] | None, theta: Array) -> Array:
    return theta if box is None else np.minimum(np.maximum(theta, box[0]), box[1])


@dataclass(frozen=True)
class _LocalModel:
    """Quadratic model of the objective: value, gradient (p,), its curvature and that of its majoriser, (p, p)."""

    value: float
    gradient: Array
    curvature: Array
    majoriser: Array


class _Objective:
    """Objective of a single problem at fixed κ and d.

    Args:
        problem: a single problem, see :func:`is_single`.
        kappa, d: (1, m).
    """

    def __init__(self, problem: Problem, kappa: Tensor, d: Tensor) -> None:
        self.kappa, self.d = kappa[0].numpy(), d[0].numpy()
        self.weight = None if problem.weight is None else problem.weight[0].numpy()
        self.box = None if problem.box is None else tuple(side.numpy() for side in problem.box)
        known = problem.prior_mean is not None and problem.prior_precision is not None
        self._mean = problem.prior_mean.reshape(-1).numpy() if known and problem.prior_mean is not None else None
        self._precision = problem.prior_precision.numpy() if problem.prior_precision is not None else None

    def value(self, theta: Array, residual: Array) -> float:
        """Objective at parameters (p,) with this residual (N, m)."""
        z = residual / self.d
        q = 0.5 * z * z
        x = self.kappa * q
        divisor = np.where(self.kappa > 0, self.kappa, 1.0)
        energy = np.where(x > 0, -np.expm1(-x) / divisor, q)
        return float((energy if self.weight is None else self.weight * energy).sum()) + self._prior(theta)

    def quadratic(self, theta: Array, residual: Array, tangents: Array, value: float | None) -> _LocalModel:
        """Quadratic model with tangents (p, N m); ``value`` is the objective if known."""
        precision = self.d**-2.0
        x = np.square(residual) * (precision * self.kappa)
        w = np.exp(-x / 2.0) * precision
        if self.weight is not None:
            w = w * self.weight
        gradient = tangents @ (w * residual).reshape(-1)
        majoriser = (tangents * w.reshape(-1)) @ tangents.T
        curvature = majoriser
        if self.kappa.any():
            curvature = majoriser - (tangents * (w * x).reshape(-1)) @ tangents.T
        if self._mean is not None and self._precision is not None:
            gradient = gradient + (theta - self._mean) @ self._precision
            majoriser, curvature = majoriser + self._precision, curvature + self._precision
        return _LocalModel(self.value(theta, residual) if value is None else value, gradient, curvature, majoriser)

    def _prior(self, theta: Array) -> float:
        if self._mean is None or self._precision is None:
            return 0.0
        away = theta - self._mean
        return float(0.5 * away @ self._precision @ away)


def _model_curvature(quadratic: _LocalModel) -> Array:
    """Curvature of the objective where it is safely positive, else that of the majoriser."""
    majoriser = quadratic.majoriser
    scale = 1.0 / np.sqrt(_positive(majoriser.diagonal()))
    scaled = majoriser * scale[:, None] * scale + 100 * np.finfo(float).eps * np.eye(len(scale))
    own = quadratic.curvature * scale[:, None] * scale
    if not np.isfinite(scaled).all():
        return majoriser
    try:
        inverse = np.linalg.inv(np.linalg.cholesky(scaled))
        share = inverse @ own @ inverse.T
        least = np.linalg.eigvalsh(0.5 * (share + share.T))[0]
    except np.linalg.LinAlgError:
        return majoriser
    return quadratic.curvature if least > TRUST else majoriser


def _positive(diagonal: Array) -> Array:
    """Marquardt's scaling; a parameter without effect gets 1."""
    return np.where(diagonal > 0, diagonal, 1.0)


def _damped_step(
    box: tuple[Array, ...] | None, theta: Array, quadratic: _LocalModel, model: Array, scaling: Array, damping: float
) -> tuple[Array, float, bool]:
    """Damped step within the box, its predicted decrease, and whether the linear system could be solved."""
    damped = model + np.diag(damping * scaling)
    gradient, step = quadratic.gradient, np.zeros_like(theta)
    held = np.zeros(len(theta), dtype=bool)
    if box is not None:
        held = ((theta <= box[0]) & (gradient > 0)) | ((theta >= box[1]) & (gradient < 0))
    solved = True
    for _ in range(len(theta) + 1):
        linear_term = gradient + damped @ np.where(held, step, 0.0)
        matrix = np.where(held[:, None] | held, 0.0, damped) + np.diag(np.where(held, _positive(scaling), 0.0))
        free, solved = _solved(matrix, np.where(held, 0.0, -linear_term))
        step = np.where(held, step, free)
        if box is None:
            break
        beyond = ~held & ((theta + step < box[0]) | (theta + step > box[1]))
        step = np.where(beyond, np.minimum(np.maximum(theta + step, box[0]), box[1]) - theta, step)
        # a parameter that reaches its bound stays there while the others are solved for again
        if not beyond.any():
            break
        held = held | beyond
    predicted = -gradient @ step - 0.5 * step @ model @ step
    return step, float(predicted), solved and bool(np.isfinite(step).all())


def _solved(matrix: Array, right: Array) -> tuple[Array, bool]:
    """Solution for a positive definite matrix, and whether the matrix is positive definite."""
    try:
        lower = np.linalg.cholesky(matrix)
        return np.linalg.solve(lower.T, np.linalg.solve(lower, right)), bool(np.isfinite(lower).all())
    except np.linalg.LinAlgError:
        return np.full_like(right, np.nan), False
