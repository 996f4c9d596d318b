"""The objective of one problem without constraints, with NumPy: a tensor operation costs more than its few numbers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mkc_torch.nonlinear._problem import NONLINEAR, TRUST, Descent, Problem, ProblemPoint

__all__ = ["descended_alone", "is_alone"]

Array = NDArray[np.float64]


def is_alone(problem: Problem, point: ProblemPoint) -> bool:
    """Whether there is one problem, without constraints, in double precision on the CPU."""
    theta = point.theta
    return (
        len(theta) == 1
        and problem.is_inequality is None
        and theta.dtype == torch.float64
        and theta.device.type == "cpu"
        and not point.residual.requires_grad
    )


def descended_alone(
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
    """As :func:`mkc_torch.nonlinear._descent.descended`, of one problem without constraints, step for step."""
    eps = float(np.finfo(float).eps)
    objective, at = _Objective(problem, kappa, d), _At.of(point)
    with np.errstate(all="ignore"):
        quadratic = objective.quadratic(at.theta, at.residual, at.tangents, None)
        model, scaling = _model_curvature(quadratic), _positive(quadratic.majoriser.diagonal())
        own, growth = 1e-4 if damping is None else float(damping[0]), 4.0
        done = taken = tired = False
        least = eps * eps * quadratic.value
        if allowance is not None:
            least = max(least, float(allowance[0]))
        n_iter = 0
        while n_iter < max_iter and not done:
            if tired:
                point = problem.refreshed(point)
                at = _At.of(point)
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
            # a step cut off by bounds may be one that the model itself thinks no good
            solved = solved and predicted >= -limit
            accept = solved and actual > 0
            rest = solved and own <= 1.0 and predicted <= limit and not actual > limit
            rest = rest or (solved and bool((np.abs(step) <= 4 * eps * np.abs(at.theta)).all()))
            ratio = min(actual / max(predicted, np.finfo(float).tiny), 2.0)
            taken = accept
            if accept:
                own, growth = own * min(max(1.0 - (2.0 * ratio - 1.0) ** 3, 0.1), 2.0), 4.0
            elif not rest:
                # a step that old derivatives have led astray says nothing about the damping
                own, growth = own if point.stale else own * growth, 2.0 * growth
            own = min(max(own, 100 * eps), 1e16)
            unforeseen = _unforeseen(at, step, after) > NONLINEAR
            led = point.stale and exact
            tired = bool((unforeseen and accept and not rest) or (rest and led))
            tired = tired or (point.stale and not accept and not rest)
            done = rest and not led
            if accept:
                stale = point.stale or not rest
                point = replace(point, theta=there, residual=residual, stale=stale)
                at = _At(theta, after, at.tangents)
                if n_iter < max_iter and not done and not tired:
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
        tired,
        torch.full_like(like, taken, dtype=torch.bool),
        torch.full_like(like, own),
        n_iter,
    )


@dataclass(frozen=True)
class _At:
    """Parameters (p,) with their residual (N, m) and tangents (p, N m)."""

    theta: Array
    residual: Array
    tangents: Array

    @classmethod
    def of(cls, point: ProblemPoint) -> _At:
        return cls(point.theta[0].numpy(), point.residual[0].numpy(), point.tangents[0].numpy())


def _unforeseen(at: _At, step: Array, after: Array) -> float:
    """The share of a step's effect on residuals that the derivatives at hand did not predict."""
    linear = step @ at.tangents
    off = np.square((after - at.residual).reshape(-1) - linear).sum() / np.square(linear).sum()
    return 0.0 if np.isnan(off) else float(np.sqrt(off))


def _within(box: tuple[Array, ...] | None, theta: Array) -> Array:
    return theta if box is None else np.minimum(np.maximum(theta, box[0]), box[1])


@dataclass(frozen=True)
class _LocalModel:
    """The objective about a point: its value, gradient (p,), and the curvatures (p, p) of it and of its majoriser."""

    value: float
    gradient: Array
    curvature: Array
    majoriser: Array


class _Objective:
    """One problem at fixed κ and d.

    Args:
        problem: of which there is one, see :func:`is_alone`.
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
        """The objective of parameters (p,) with this residual (N, m)."""
        z = residual / self.d
        q = 0.5 * z * z
        x = self.kappa * q
        divisor = np.where(self.kappa > 0, self.kappa, 1.0)
        energy = np.where(x > 0, -np.expm1(-x) / divisor, q)
        return float((energy if self.weight is None else self.weight * energy).sum()) + self._prior(theta)

    def quadratic(self, theta: Array, residual: Array, tangents: Array, value: float | None) -> _LocalModel:
        """The quadratic model with tangents (p, N m); ``value`` is the objective where it is known."""
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
    """The objective's own curvature where it is safely positive, and that of the majoriser elsewhere."""
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
    """Marquardt's scaling; a parameter without effect has no scale and gets 1."""
    return np.where(diagonal > 0, diagonal, 1.0)


def _damped_step(
    box: tuple[Array, ...] | None, theta: Array, quadratic: _LocalModel, model: Array, scaling: Array, damping: float
) -> tuple[Array, float, bool]:
    """The damped step within the box, the decrease that the model predicts for it, and whether it could be solved."""
    damped = model + np.diag(damping * scaling)
    gradient, step = quadratic.gradient, np.zeros_like(theta)
    held = np.zeros(len(theta), dtype=bool)
    if box is not None:
        held = ((theta <= box[0]) & (gradient > 0)) | ((theta >= box[1]) & (gradient < 0))
    solved = True
    for _ in range(len(theta) + 1):
        pulled = gradient + damped @ np.where(held, step, 0.0)
        matrix = np.where(held[:, None] | held, 0.0, damped) + np.diag(np.where(held, _positive(scaling), 0.0))
        free, solved = _solved(matrix, np.where(held, 0.0, -pulled))
        step = np.where(held, step, free)
        if box is None:
            break
        beyond = ~held & ((theta + step < box[0]) | (theta + step > box[1]))
        step = np.where(beyond, np.minimum(np.maximum(theta + step, box[0]), box[1]) - theta, step)
        # a parameter that meets its bound stays there while the others are solved for again
        if not beyond.any():
            break
        held = held | beyond
    predicted = -gradient @ step - 0.5 * step @ model @ step
    return step, float(predicted), solved and bool(np.isfinite(step).all())


def _solved(matrix: Array, right: Array) -> tuple[Array, bool]:
    """The solution with a positive definite matrix, and whether it is one."""
    try:
        lower = np.linalg.cholesky(matrix)
        return np.linalg.solve(lower.T, np.linalg.solve(lower, right)), bool(np.isfinite(lower).all())
    except np.linalg.LinAlgError:
        return np.full_like(right, np.nan), False
