"""Robust Levenberg-Marquardt and MKC-EM on any differentiable residual.

:func:`minimise` minimises the MKC energy of a residual over its parameters at given σ and d; :func:`fit` learns σ and d
of each channel too. Both take a prior, bounds, equalities and inequalities, and a batch of problems at once.
"""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map

from mkc_torch.density_fit import DensityState, conclusive, domain_rule, initial_state, newton_step, refuse_narrow_bound
from mkc_torch.functional import energy_value
from mkc_torch.linear.covariance import CovarianceKind, checked_bandwidth, checked_kind, sandwich
from mkc_torch.order_statistic import order_statistic

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["GaussianPrior", "NonlinearFit", "Solution", "fit", "minimise"]

Residual = Callable[..., Tensor]
Constraint = Callable[[Tensor], Tensor]

_FLOOR = 0.3
"""Least d in robust scales: a scale is at most doubled by outliers, and a fit that interpolates ends far below."""

_KERNELS = (10.0, 4.0, 1.6, 0.7)
"""Widths of the kernel in robust scales, in turn: wide ones have few local minima, narrow ones no pull by outliers."""

_TRUST = 0.1
"""Least share of the majoriser's curvature, in every direction, at which the objective's own curvature is used."""

_MULTIPLIERS = 30
"""Sets of multipliers at most."""

_NONLINEAR = 0.03
"""Least share of a step's effect that the Jacobian did not foresee at which a new one is taken."""

_STIFFNESS = 100.0
"""Curvature of the penalty over that of the objective along a constraint: each outer step gains about this factor."""


@dataclass(frozen=True)
class GaussianPrior:
    """A Gaussian on the parameters, ``½ (θ - mean)ᵀ P (θ - mean)`` added to the objective.

    Attributes:
        mean: (p,).
        precision: the diagonal of P (p,), or P (p, p), symmetric and positive semi-definite, in 1 / unit².
    """

    mean: Float[Tensor, " p"]
    precision: Float[Tensor, " p"] | Float[Tensor, "p p"]


@dataclass(frozen=True)
class Solution:
    """Where :func:`minimise` came to rest.

    Attributes:
        theta: (*, p).
        residual: (*, N, m) at ``theta``; 0 where the weight is 0.
        weights: ``exp(-e² / (2 d² σ²))`` of each residual, (*, N, m).
        objective: the sum of energies and the prior's term, (*,), without any penalty of constraints.
        n_iter: trial steps made.
        converged: (*,).
        jacobian: of the residual at ``theta``, (*, N, m, p).
        curvature: of the objective at ``theta``, ``Σ w (1 - z²/σ²) JᵀJ / d²`` and the prior's precision, (*, p, p).
    """

    theta: Float[Tensor, "*batch p"]
    residual: Float[Tensor, "*batch N m"]
    weights: Float[Tensor, "*batch N m"]
    objective: Float[Tensor, " *batch"]
    n_iter: int
    converged: Bool[Tensor, " *batch"]
    jacobian: Float[Tensor, "*batch N m p"]
    curvature: Float[Tensor, "*batch p p"]


@dataclass(frozen=True)
class NonlinearFit:
    """What :func:`fit` found.

    Attributes:
        theta: (*, p).
        sigma, d, bound: bandwidth (``inf`` for a Gaussian channel), scale and half-width of the domain, (*, m).
        log_likelihood: nats per sample: the mean over the samples of each channel, summed over the channels, (*,),
            without the prior; compare only at equal ``bound``.
        weights: ``exp(-e² / (2 d² σ²))`` of each residual, (*, N, m).
        residual: (*, N, m) at ``theta``; 0 where the weight is 0.
        covariance: of ``theta`` at the learned σ and d, (*, p, p), or None. It is 0 along active bounds and
            constraints, and infinite for parameters that the residual does not determine.
        jacobian: of the residual at ``theta``, (*, N, m, p).
        n_iter: trial steps made.
        converged: (*,).
    """

    theta: Float[Tensor, "*batch p"]
    sigma: Float[Tensor, "*batch m"]
    d: Float[Tensor, "*batch m"]
    bound: Float[Tensor, "*batch m"]
    log_likelihood: Float[Tensor, " *batch"]
    weights: Float[Tensor, "*batch N m"]
    residual: Float[Tensor, "*batch N m"]
    covariance: Float[Tensor, "*batch p p"] | None
    jacobian: Float[Tensor, "*batch N m p"]
    n_iter: int
    converged: Bool[Tensor, " *batch"]

    def standard_error(self) -> Float[Tensor, "*batch p"]:
        """Square root of the diagonal of ``covariance``, in the units of the parameters."""
        if self.covariance is None:
            raise ValueError("Expected a fit with a covariance but it was made with covariance=None; name a kind.")
        return self.covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0.0).sqrt()


@dataclass(frozen=True)
class _Problem:
    """A batch of problems, flattened to B of them."""

    function: Residual
    data: Any
    batch: torch.Size
    forward: bool
    weight: Tensor | None = None
    used: Tensor | None = None  # None: all residuals are
    prior_mean: Tensor | None = None
    prior_precision: Tensor | None = None
    box: tuple[Tensor, Tensor] | None = None  # (p,) each
    equality: Constraint | None = None
    inequality: Constraint | None = None
    is_inequality: Tensor | None = None  # (k,); None: unconstrained

    def _over_batch(self, function: Callable[..., Tensor], theta: Tensor) -> Tensor:
        arguments = (theta,) if self.data is None else (theta, self.data)
        if theta.shape[0] == 1:
            return function(*tree_map(lambda t: t[0], arguments)).unsqueeze(0)
        return torch.func.vmap(function)(*arguments)

    def raw_residual(self, theta: Float[Tensor, "B p"]) -> Float[Tensor, "B N m"]:
        return self._over_batch(self.function, theta)

    def residual(self, theta: Float[Tensor, "B p"]) -> Float[Tensor, "B N m"]:
        residual = self.raw_residual(theta)
        return residual if self.used is None else torch.where(self.used, residual, 0.0)

    def tangents(self, theta: Float[Tensor, "B p"]) -> Float[Tensor, "B p N*m"]:
        """The transposed Jacobian: a row for each parameter, as forward mode makes them."""
        rows = self._over_batch(_forward_tangents(self.function) if self.forward else _reverse(self.function), theta)
        if self.used is not None:
            rows = torch.where(self.used.unsqueeze(1), rows, 0.0)
        return rows.flatten(2)

    def _constraints(self, theta: Tensor) -> Tensor:
        """Equalities and inequalities of one problem, (k,)."""
        return torch.cat([c(theta) for c in (self.equality, self.inequality) if c is not None])

    def constraints(self, theta: Float[Tensor, "B p"]) -> Float[Tensor, "B k"] | None:
        return None if self.is_inequality is None else replace(self, data=None)._over_batch(self._constraints, theta)

    def normals(self, theta: Float[Tensor, "B p"]) -> Float[Tensor, "B k p"] | None:
        if self.is_inequality is None:
            return None
        return replace(self, data=None)._over_batch(torch.func.jacrev(self._constraints), theta)

    def at(self, theta: Float[Tensor, "B p"]) -> _Point:
        return _Point(theta, self.residual(theta), self.tangents(theta), self.constraints(theta), self.normals(theta))

    def refreshed(self, point: _Point) -> _Point:
        """The point with derivatives taken at its own parameters."""
        if not point.stale:
            return point
        return replace(point, tangents=self.tangents(point.theta), normals=self.normals(point.theta), stale=False)

    def select(self, index: Tensor) -> _Problem:
        def take(value: Tensor | None) -> Tensor | None:
            return None if value is None else value[index]

        return replace(
            self,
            data=None if self.data is None else tree_map(lambda t: t[index], self.data),
            weight=take(self.weight),
            used=take(self.used),
        )

    def restore(self, value: Tensor) -> Tensor:
        return value.reshape((*self.batch, *value.shape[1:]))


@dataclass(frozen=True)
class _Point:
    theta: Float[Tensor, "B p"]
    residual: Float[Tensor, "B N m"]
    tangents: Float[Tensor, "B p N*m"]
    constraint: Float[Tensor, "B k"] | None = None
    normals: Float[Tensor, "B k p"] | None = None
    stale: bool = False  # the derivatives are those of a point nearby

    def moved(self, accept: Tensor, theta: Tensor, residual: Tensor, constraint: Tensor | None) -> _Point:
        return replace(
            self,
            theta=torch.where(accept[:, None], theta, self.theta),
            residual=torch.where(accept[:, None, None], residual, self.residual),
            constraint=None
            if constraint is None or self.constraint is None
            else torch.where(accept[:, None], constraint, self.constraint),
            stale=True,
        )

    def select(self, index: Tensor) -> _Point:
        return _Point(
            self.theta[index],
            self.residual[index],
            self.tangents[index],
            None if self.constraint is None else self.constraint[index],
            None if self.normals is None else self.normals[index],
            self.stale,
        )

    def write(self, index: Tensor, part: _Point) -> _Point:
        def merged(whole: Tensor | None, some: Tensor | None) -> Tensor | None:
            return None if whole is None or some is None else whole.index_copy(0, index, some)

        return _Point(
            self.theta.index_copy(0, index, part.theta),
            self.residual.index_copy(0, index, part.residual),
            self.tangents.index_copy(0, index, part.tangents),
            merged(self.constraint, part.constraint),
            merged(self.normals, part.normals),
            self.stale or part.stale,
        )


@functools.cache
def load_forward_mode() -> None:
    """Torch compiles its rules for forward mode at the first use, by a function that it deprecates itself."""
    one = torch.ones(1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.func.jvp(torch.sin, (one,), (one,))


def beside(constant: Tensor, moving: Tensor) -> Tensor:
    """A constant, with a tangent of zeros where one number, ``moving``, has a tangent.

    What has none is added and multiplied by reference functions written in Python, half a millisecond each and a second
    at their first use.
    """
    if not torch._C._functorch.is_functorch_wrapped_tensor(moving):
        return constant
    return torch.where(torch.ones((), dtype=torch.bool, device=constant.device), constant, moving)


def _forward_tangents(function: Residual) -> Residual:
    load_forward_mode()

    def tangents(theta: Tensor, *data: Any) -> Tensor:
        def along(direction: Tensor) -> Tensor:
            return torch.func.jvp(lambda t: function(t, *data), (theta,), (direction,))[1]

        basis = torch.eye(theta.shape[0], dtype=theta.dtype, device=theta.device)
        return torch.func.vmap(along)(basis)

    return tangents


def _reverse(function: Residual) -> Residual:
    def tangents(theta: Tensor, *data: Any) -> Tensor:
        jacobian: Tensor = torch.func.jacrev(function)(theta, *data)
        return jacobian.movedim(-1, 0)

    return tangents


@dataclass(frozen=True)
class _Penalty:
    """The augmented Lagrangian ``½ ρ (c + u/ρ)²``, cut off at 0 for inequalities; multipliers and ρ are (B, k)."""

    multiplier: Tensor
    rho: Tensor

    def excess(self, problem: _Problem, constraint: Tensor) -> Tensor:
        shifted = constraint + self.multiplier / self.rho
        assert problem.is_inequality is not None
        return torch.where(problem.is_inequality, shifted.clamp(max=0.0), shifted)


@dataclass(frozen=True)
class _Quadratic:
    """The objective about a point: its value (B,), gradient (B, p) and two curvatures (B, p, p)."""

    value: Tensor
    gradient: Tensor
    curvature: Tensor
    majoriser: Tensor


def _prior_value(problem: _Problem, theta: Tensor) -> Tensor:
    if problem.prior_mean is None or problem.prior_precision is None:
        return torch.zeros_like(theta[:, 0])
    away = theta - problem.prior_mean
    return 0.5 * (away * (away @ problem.prior_precision)).sum(-1)


def _value(
    problem: _Problem,
    theta: Tensor,
    residual: Tensor,
    constraint: Tensor | None,
    kappa: Tensor,
    d: Tensor,
    penalty: _Penalty | None,
) -> Float[Tensor, " B"]:
    energies = energy_value(residual / d.unsqueeze(-2), kappa.unsqueeze(-2))
    value = (energies if problem.weight is None else problem.weight * energies).sum((-2, -1))
    value = value + _prior_value(problem, theta)
    if penalty is not None and constraint is not None:
        value = value + 0.5 * (penalty.rho * penalty.excess(problem, constraint).square()).sum(-1)
    return value


def _gram(tangents: Float[Tensor, "B p K"], weight: Float[Tensor, "B K"]) -> Float[Tensor, "B p p"]:
    return torch.matmul(tangents * weight.unsqueeze(-2), tangents.mT)


def _quadratic(
    problem: _Problem, point: _Point, kappa: Tensor, d: Tensor, penalty: _Penalty | None, value: Tensor | None = None
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
        value = _value(problem, point.theta, point.residual, point.constraint, kappa, d, penalty)
    return _Quadratic(value, gradient, majoriser - lowered, majoriser)


def _model_curvature(quadratic: _Quadratic) -> Tensor:
    """The objective's own curvature where it is safely positive, and that of the majoriser elsewhere."""
    majoriser = quadratic.majoriser
    scale = _positive(majoriser.diagonal(dim1=-2, dim2=-1)).rsqrt()
    scaled = majoriser * scale.unsqueeze(-1) * scale.unsqueeze(-2)
    eps = torch.finfo(scale.dtype).eps
    eye = torch.eye(scale.shape[-1], dtype=scale.dtype, device=scale.device)
    factor, failed = torch.linalg.cholesky_ex(scaled + 100 * eps * eye)
    own = quadratic.curvature * scale.unsqueeze(-1) * scale.unsqueeze(-2)
    half = torch.linalg.solve_triangular(factor, own, upper=False)
    share = torch.linalg.solve_triangular(factor, half.mT, upper=False).nan_to_num(0.0, 0.0, 0.0)
    least = torch.linalg.eigvalsh(0.5 * (share + share.mT))[..., 0]
    trusted = (failed == 0) & (least > _TRUST)
    return torch.where(trusted[:, None, None], quadratic.curvature, majoriser)


def _positive(diagonal: Tensor) -> Tensor:
    """Marquardt's scaling; a parameter without effect has no scale and gets 1."""
    return torch.where(diagonal > 0, diagonal, 1.0)


def _within(box: tuple[Tensor, Tensor] | None, theta: Tensor) -> Tensor:
    return theta if box is None else torch.minimum(torch.maximum(theta, box[0]), box[1])


def _step(
    problem: _Problem, theta: Tensor, gradient: Tensor, model: Tensor, scaling: Tensor, damping: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The damped step within the box, the decrease that the model predicts for it, and whether it could be solved."""
    damped = model + torch.diag_embed(damping.unsqueeze(-1) * scaling)
    held = torch.zeros_like(theta, dtype=torch.bool)
    step = torch.zeros_like(theta)
    if problem.box is not None:
        lower, upper = problem.box
        held = ((theta <= lower) & (gradient > 0)) | ((theta >= upper) & (gradient < 0))
    solved = torch.ones_like(damping, dtype=torch.bool)
    for _ in range(theta.shape[-1] + 1):
        pulled = gradient + torch.matmul(damped, torch.where(held, step, 0.0).unsqueeze(-1)).squeeze(-1)
        coupled = held.unsqueeze(-1) | held.unsqueeze(-2)
        matrix = torch.where(coupled, 0.0, damped) + torch.diag_embed(torch.where(held, _positive(scaling), 0.0))
        factor, failed = torch.linalg.cholesky_ex(matrix)
        solved = failed == 0
        free = torch.cholesky_solve(torch.where(held, 0.0, -pulled).unsqueeze(-1), factor).squeeze(-1)
        step = torch.where(held, step, free)
        if problem.box is None:
            break
        beyond = ~held & ((theta + step < lower) | (theta + step > upper))
        step = torch.where(beyond, _within(problem.box, theta + step) - theta, step)
        # a parameter that meets its bound stays there while the others are solved for again
        if not bool(beyond.any()):
            break
        held = held | beyond
    predicted = -(gradient * step).sum(-1) - 0.5 * (step * torch.matmul(model, step.unsqueeze(-1)).squeeze(-1)).sum(-1)
    return step, predicted, solved & torch.isfinite(step).all(-1)


@dataclass(frozen=True)
class _Descent:
    point: _Point
    value: Tensor
    quiet: Tensor  # at rest: neither the step nor the model, of fresh derivatives, promises more than the limit
    tired: bool  # the derivatives are too old to go on with
    taken: Tensor  # whether the last trial was accepted
    damping: Tensor
    n_iter: int


def _descend(
    problem: _Problem,
    point: _Point,
    kappa: Tensor,
    d: Tensor,
    penalty: _Penalty | None,
    *,
    max_iter: int,
    tol: float,
    allowance: Tensor | None = None,
    damping: Tensor | None = None,
    exact: bool = True,
) -> _Descent:
    """Levenberg-Marquardt on the objective at fixed σ, d and penalty; never uphill.

    A problem rests when a barely damped step promises and brings no more than ``tol`` of the objective, or than
    ``allowance``; unless ``exact``, with derivatives of a point nearby too.
    """
    eps = torch.finfo(point.theta.dtype).eps
    quadratic = _quadratic(problem, point, kappa, d, penalty)
    model = _model_curvature(quadratic)
    scaling = _positive(quadratic.majoriser.diagonal(dim1=-2, dim2=-1))
    if damping is None:
        damping = torch.full_like(quadratic.value, 1e-4)
    growth = torch.full_like(damping, 4.0)
    done = torch.zeros_like(damping, dtype=torch.bool)
    taken = torch.zeros_like(done)
    least = eps * eps * quadratic.value
    if allowance is not None:
        least = torch.maximum(least, allowance)
    n_iter, tired = 0, False
    while n_iter < max_iter and not bool(done.all()):
        if tired:
            point = problem.refreshed(point)
            quadratic = _quadratic(problem, point, kappa, d, penalty, quadratic.value)
            model = _model_curvature(quadratic)
            scaling = _positive(torch.maximum(quadratic.majoriser.diagonal(dim1=-2, dim2=-1), 1e-6 * scaling))
        n_iter += 1
        step, predicted, solved = _step(problem, point.theta, quadratic.gradient, model, scaling, damping)
        theta = _within(problem.box, point.theta + step)
        residual, constraint = problem.residual(theta), problem.constraints(theta)
        value = _value(problem, theta, residual, constraint, kappa, d, penalty)
        actual = quadratic.value - value
        limit = torch.maximum(max(tol, 16 * eps) * quadratic.value, least)
        # a step cut off by bounds may be one that the model itself thinks no good
        solved = solved & (predicted >= -limit)
        accept = solved & (actual > 0) & ~done
        rest = solved & (damping <= 1.0) & (predicted <= limit) & ~(actual > limit)
        rest = rest | (solved & (step.abs() <= 4 * eps * point.theta.abs()).all(-1))
        ratio = (actual / predicted.clamp(min=torch.finfo(actual.dtype).tiny)).clamp(max=2.0)
        shrink = (1.0 - (2.0 * ratio - 1.0).pow(3)).clamp(0.1, 2.0)
        taken = torch.where(done, taken, accept)
        blamed = ~accept & ~rest & ~done
        # a step that old derivatives have led astray says nothing about the damping
        changed = torch.where(
            accept, damping * shrink, torch.where(blamed & (not point.stale), damping * growth, damping)
        )
        growth = torch.where(accept, 4.0, torch.where(blamed, 2.0 * growth, growth))
        damping = torch.where(done, damping, changed.clamp(100 * eps, 1e16))
        unforeseen = _unforeseen(point, step, residual, constraint) > _NONLINEAR
        led = point.stale and exact
        tired = bool((unforeseen & accept & ~rest).any()) or bool((rest & led | blamed & point.stale).any())
        done = done | (rest & (not led))
        if bool(accept.any()):
            moved = bool((accept & ~rest).any())
            point = replace(point.moved(accept, theta, residual, constraint), stale=moved or point.stale)
            current = torch.where(accept, value, quadratic.value)
            if n_iter < max_iter and not bool(done.all()) and not tired:
                quadratic = _quadratic(problem, point, kappa, d, penalty, current)
                model = _model_curvature(quadratic)
            else:
                quadratic = replace(quadratic, value=current)
        elif bool((done | (damping >= 1e15)).all()):
            break
    return _Descent(point, quadratic.value, done, tired, taken, damping, n_iter)


def _unforeseen(point: _Point, step: Tensor, residual: Tensor, constraint: Tensor | None) -> Float[Tensor, " B"]:
    """The share of a step's effect on residuals and constraints that the derivatives at hand did not predict."""
    linear = torch.matmul(step.unsqueeze(-2), point.tangents).squeeze(-2)
    change = (residual - point.residual).flatten(1)
    error = (change - linear).square().sum(-1) / linear.square().sum(-1)
    if constraint is not None and point.constraint is not None and point.normals is not None:
        linear = torch.matmul(point.normals, step.unsqueeze(-1)).squeeze(-1)
        off = (constraint - point.constraint - linear).square().sum(-1) / linear.square().sum(-1)
        error = torch.maximum(error, off)
    return error.sqrt().nan_to_num(0.0, torch.inf)


def _first_penalty(problem: _Problem, point: _Point, kappa: Tensor, d: Tensor) -> _Penalty | None:
    """Multipliers 0 and a ρ that is stiff against the objective along each constraint."""
    if point.constraint is None or point.normals is None:
        return None
    majoriser = _quadratic(problem, point, kappa, d, None).majoriser
    scale = _positive(majoriser.diagonal(dim1=-2, dim2=-1)).rsqrt()
    scaled = majoriser * scale.unsqueeze(-1) * scale.unsqueeze(-2)
    eye = torch.eye(scale.shape[-1], dtype=scale.dtype, device=scale.device)
    normals = point.normals * scale.unsqueeze(-2)
    yielding = (normals * torch.linalg.solve(scaled + 1e-6 * eye, normals.mT).mT).sum(-1)
    rho = _STIFFNESS / torch.where(yielding > 0, yielding, 1.0)
    return _Penalty(torch.zeros_like(rho), rho)


def _constrained(
    problem: _Problem,
    point: _Point,
    kappa: Tensor,
    d: Tensor,
    *,
    max_iter: int,
    tol: float,
    penalty: _Penalty | None = None,
    damping: Tensor | None = None,
    allowance: Tensor | None = None,
    exact: bool = True,
) -> tuple[_Descent, _Penalty | None]:
    """A descent, repeated with better multipliers until the constraints hold."""
    if penalty is None and problem.is_inequality is not None:
        penalty = _first_penalty(problem, problem.refreshed(point), kappa, d)
    if penalty is None:
        found = _descend(
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
        found = _descend(
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
        # a constraint rests when it holds and, where it is an inequality with slack, pulls no more
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
        if bool((holds & found.quiet).all()) and 10.0 ** (-3 - 2 * outer) <= max(tol, 1e-9):
            break
        previous = off
        penalty = _Penalty(multiplier, rho)
    return replace(found, n_iter=n_iter, quiet=found.quiet & holds), penalty


def _channels(name: str, value: float | Tensor, like: Tensor, batch: torch.Size, *, infinite: bool) -> Tensor:
    """A positive parameter of every channel, (B, m), from a number, (m,) or (*, m)."""
    t = torch.as_tensor(value, dtype=like.dtype, device=like.device)
    if not bool(((t > 0) & (torch.isfinite(t) | infinite)).all()):
        kind = "positive" if infinite else "positive and finite"
        raise ValueError(f"Expected argument `{name}` to be {kind} but got {value}.")
    m = like.shape[-1]
    try:
        return t.expand(*batch, m).reshape(-1, m)
    except RuntimeError:
        raise ValueError(
            f"Expected argument `{name}` to be a number, ({m},) or {(*batch, m)} but got {tuple(t.shape)}."
        ) from None


def _prepared(
    residual: Residual,
    start: Tensor,
    *,
    data: Any,
    weight: Tensor | None,
    prior: GaussianPrior | None,
    lower: Tensor | None,
    upper: Tensor | None,
    equality: Constraint | None,
    inequality: Constraint | None,
    jacobian: str,
) -> tuple[_Problem, _Point]:
    """The checked problem and its start."""
    if not isinstance(start, Tensor) or not start.is_floating_point():
        got = start.dtype if isinstance(start, Tensor) else type(start).__name__
        raise TypeError(f"Expected argument `start` to be a real floating-point tensor but got {got}.")
    if start.dim() == 0 or start.shape[-1] == 0 or start.numel() == 0:
        raise ValueError(f"Expected argument `start` of shape (*, p >= 1) but got {tuple(start.shape)}.")
    if not bool(torch.isfinite(start).all()):
        raise ValueError(
            f"Expected argument `start` to be finite but got {int((~torch.isfinite(start)).sum())} values that are not."
        )
    if jacobian not in ("forward", "reverse"):
        raise ValueError(f"Expected argument `jacobian` to be 'forward' or 'reverse' but got {jacobian!r}.")
    batch, p = start.shape[:-1], start.shape[-1]
    theta = start.detach().reshape(-1, p)
    box = _box(lower, upper, theta)
    theta = _within(box, theta)
    for leaf in tree_leaves(data):
        if isinstance(leaf, Tensor) and leaf.shape[: len(batch)] != batch:
            raise ValueError(
                f"Expected every tensor in argument `data` to begin with the batch dimensions {tuple(batch)} of "
                f"`start` but got {tuple(leaf.shape)}."
            )
    flat = None if data is None else tree_map(lambda t: t.reshape(theta.shape[0], *t.shape[len(batch) :]), data)
    mean, precision = _checked_prior(prior, theta)
    problem = _Problem(
        residual,
        flat,
        batch,
        jacobian == "forward",
        prior_mean=mean,
        prior_precision=precision,
        box=box,
        equality=equality,
        inequality=inequality,
    )
    first = problem.raw_residual(theta)
    if first.dim() != 3 or first.shape[1] == 0 or first.shape[2] == 0:
        raise ValueError(
            f"Expected `residual` to return a tensor (N, m) but got shape {tuple(first.shape[1:])}; "
            "one channel is (N, 1)."
        )
    if first.dtype != theta.dtype:
        raise TypeError(
            f"Expected `residual` to return the dtype of `start`, {theta.dtype}, but got {first.dtype}; convert one."
        )
    full_weight, used = _checked_weight(weight, first, batch)
    count = torch.full_like(theta[:, 0], float(first[0].numel())) if used is None else used.sum((-2, -1)).to(theta)
    strength = 0 if precision is None else int(torch.linalg.matrix_rank(precision, hermitian=True))
    if float(count.min()) + strength < p:
        raise ValueError(
            f"Expected at least as many residuals as parameters, {p}, but got {int(count.min())}; "
            "add samples or a prior."
        )
    wrong = ~torch.isfinite(first) if used is None else ~torch.isfinite(first) & used
    if bool(wrong.any()):
        raise ValueError(
            f"Expected `residual` to be finite at `start` but got {int(wrong.sum())} of {first.numel()} values that "
            "are not; start elsewhere, or leave those samples out by a weight of 0."
        )
    kinds = [
        torch.full((_constraint_count(name, c, theta[0]),), name == "inequality", device=theta.device)
        for name, c in (("equality", equality), ("inequality", inequality))
        if c is not None
    ]
    problem = replace(problem, weight=full_weight, used=used, is_inequality=torch.cat(kinds) if kinds else None)
    point = problem.at(theta)
    broken = int((~torch.isfinite(point.tangents)).sum())
    if broken:
        raise ValueError(
            f"Expected `residual` to have finite derivatives at `start` but got {broken} values that are not; "
            "start elsewhere."
        )
    return problem, point


def _box(lower: Tensor | None, upper: Tensor | None, theta: Tensor) -> tuple[Tensor, Tensor] | None:
    if lower is None and upper is None:
        return None
    p = theta.shape[-1]
    sides = []
    for name, side, default in (("lower", lower, -math.inf), ("upper", upper, math.inf)):
        t = torch.as_tensor(default if side is None else side, dtype=theta.dtype, device=theta.device)
        if t.dim() > 1 or (t.dim() == 1 and t.shape[0] != p) or bool(torch.isnan(t).any()):
            raise ValueError(
                f"Expected argument `{name}` to be {p} numbers, infinite for no bound, but got "
                f"{'NaN' if bool(torch.isnan(t).any()) else tuple(t.shape)}."
            )
        sides.append(t.expand(p))
    low, high = sides
    crossed = (low > high).nonzero().squeeze(-1).tolist()
    if crossed:
        raise ValueError(
            f"Expected argument `lower` to be at most `upper` but got more for the parameters {crossed}; swap them."
        )
    return low, high


def _checked_prior(prior: GaussianPrior | None, theta: Tensor) -> tuple[Tensor | None, Tensor | None]:
    if prior is None:
        return None, None
    p = theta.shape[-1]
    mean, precision = torch.as_tensor(prior.mean).to(theta), torch.as_tensor(prior.precision).to(theta)
    if mean.shape != (p,) or precision.shape not in ((p,), (p, p)):
        raise ValueError(
            f"Expected argument `prior` with a mean ({p},) and a precision ({p},) or ({p}, {p}) but got "
            f"{tuple(mean.shape)} and {tuple(precision.shape)}."
        )
    matrix = torch.diag(precision) if precision.dim() == 1 else precision
    finite = bool(torch.isfinite(mean).all()) and bool(torch.isfinite(matrix).all())
    if finite:
        size = matrix.diagonal().abs().clamp(min=torch.finfo(matrix.dtype).tiny).rsqrt()
        scaled = matrix * size.unsqueeze(-1) * size
        slack = 1e3 * torch.finfo(matrix.dtype).eps
        definite = float(torch.linalg.eigvalsh(scaled)[0]) >= -slack
        symmetric = bool(((scaled - scaled.mT).abs() <= slack).all())
    if not finite or not definite or not symmetric:
        raise ValueError(
            "Expected argument `prior` with finite values and a symmetric positive semi-definite precision but got "
            f"{precision.tolist()}."
        )
    return mean, matrix


def _checked_weight(weight: Tensor | None, first: Tensor, batch: torch.Size) -> tuple[Tensor | None, Tensor | None]:
    """Weights (B, N, m) and which of them are positive; None where all are."""
    if weight is None:
        return None, None
    N, m = first.shape[1:]
    w = torch.as_tensor(weight).to(first)
    if w.shape == (N,):
        w = w.unsqueeze(-1)
    try:
        w = w.expand(*batch, N, m).reshape(-1, N, m)
    except RuntimeError:
        raise ValueError(
            f"Expected argument `weight` of shape ({N},), ({N}, {m}) or {(*batch, N, m)} but got {tuple(w.shape)}."
        ) from None
    if not bool(torch.isfinite(w).all()) or bool((w < 0).any()) or bool((w.sum(-2) <= 0).any()):
        raise ValueError("Expected argument `weight` to be finite, >= 0 and positive somewhere in every channel.")
    used = w > 0
    return w, None if bool(used.all()) else used


def _constraint_count(name: str, constraint: Constraint, theta: Tensor) -> int:
    value = constraint(theta)
    if value.dim() != 1 or not bool(torch.isfinite(value).all()):
        raise ValueError(
            f"Expected argument `{name}` to return finite values (k,) at `start` but got {value.tolist()}; "
            "one constraint is (1,)."
        )
    return value.shape[0]


def _kernel(residual: Tensor, kappa: Tensor, d: Tensor) -> Tensor:
    return torch.exp((-0.5 * kappa / d.square()).unsqueeze(-2) * residual.square())


def _shaped_jacobian(problem: _Problem, point: _Point) -> Tensor:
    return problem.restore(point.tangents.unflatten(-1, point.residual.shape[1:]).movedim(1, -1))


@torch.no_grad()
def minimise(
    residual: Residual,
    start: Float[Tensor, "*batch p"],
    *,
    sigma: float | Tensor = math.inf,
    d: float | Tensor = 1.0,
    data: Any = None,
    weight: Tensor | None = None,
    prior: GaussianPrior | None = None,
    lower: Float[Tensor, " p"] | None = None,
    upper: Float[Tensor, " p"] | None = None,
    equality: Constraint | None = None,
    inequality: Constraint | None = None,
    max_iter: int = 50,
    tol: float = 1e-10,
    jacobian: Literal["forward", "reverse"] = "forward",
) -> Solution:
    """Minimise the MKC energy ``Σ w σ² (1 - exp(-e² / (2 d² σ²)))`` of a residual over its parameters.

    Levenberg-Marquardt: the curvature is that of the objective without the residual's second derivatives,
    ``Σ w exp(-z²/(2σ²)) (1 - z²/σ²) JᵀJ / d²`` with z = e/d, where it is safely positive, and otherwise the positive
    definite one of its majoriser (reweighted least squares), without the bracket. The damping is scaled by the column
    norms and steered by the gain on the true objective, which never rises. σ and d are fixed; :func:`fit` learns them.

    Bounds are kept by an active set: every iterate lies within them, and parameters at a bound that the gradient
    pushes outwards are held. Equalities and inequalities are met by an augmented Lagrangian, to 1e-9 (float32: 1e-5)
    of ``1 + Σ |∂c/∂θ| |θ|``; iterates before the last may violate them.

    Args:
        residual: ``residual(theta)`` of (p,) parameters, (N, m); made of torch operations that ``torch.func.vmap``
            and forward-mode differentiation know. With ``data``, ``residual(theta, data)``.
        start: (*, p); over its leading dimensions the problems are independent, by ``torch.func.vmap``. A start
            outside the bounds is moved to the nearest point within.
        sigma: bandwidth, dimensionless: a number, (m,) or (*, m); ``inf`` is weighted least squares.
        d: scale in the unit of the residual: a number, (m,) or (*, m).
        data: a tensor, or dicts, tuples and lists of tensors, whose leading dimensions are those of ``start``.
        weight: non-negative weights (N,), (N, m) or (*, N, m); 0 leaves a residual out, whatever it is.
        prior: adds ``½ (θ - mean)ᵀ P (θ - mean)``.
        lower, upper: bounds (p,), infinite for none.
        equality: ``equality(theta) = 0``, (k,).
        inequality: ``inequality(theta) >= 0``, (k,).
        max_iter: trial steps at most; with constraints, for each of up to 30 sets of multipliers.
        tol: a problem has converged when a step promises and brings a decrease of less than this share of the
            objective.
        jacobian: "forward" is quick for few parameters, "reverse" for few residuals.

    Raises:
        TypeError: ``start`` is no floating tensor, or the residual has another dtype.
        ValueError: wrong shapes, more parameters than residuals (without a prior), a residual or derivative that is
            not finite at ``start``, crossed bounds, or a parameter out of range.

    References:
        Marquardt, "An algorithm for least-squares estimation of nonlinear parameters", SIAM J. Appl. Math. 11 (1963).
        Nielsen, "Damping parameter in Marquardt's method", IMM, Technical University of Denmark (1999).
        Nocedal & Wright, Numerical Optimization (2006), 10.3, 16.7 and 17.3.

    Example:
        >>> t = torch.linspace(0, 4, 50, dtype=torch.float64)
        >>> y = 3.0 * torch.exp(-0.7 * t)
        >>> y[::5] += 2.0
        >>> def decay(theta):
        ...     return (theta[0] * torch.exp(-theta[1] * t) - y).unsqueeze(-1)
        >>> minimise(decay, torch.tensor([2.0, 1.0]).double(), sigma=1.0, d=0.1).theta
        tensor([3.0000, 0.7000], dtype=torch.float64)
    """
    if max_iter < 1:
        raise ValueError(f"Expected argument `max_iter` to be at least 1 but got {max_iter}.")
    problem, point = _prepared(
        residual,
        start,
        data=data,
        weight=weight,
        prior=prior,
        lower=lower,
        upper=upper,
        equality=equality,
        inequality=inequality,
        jacobian=jacobian,
    )
    kappa = _channels("sigma", sigma, point.residual, problem.batch, infinite=True).pow(-2)
    scale = _channels("d", d, point.residual, problem.batch, infinite=False)
    found, _ = _constrained(problem, point, kappa, scale, max_iter=max_iter, tol=tol)
    point = problem.refreshed(replace(found.point, stale=True))
    quadratic = _quadratic(problem, point, kappa, scale, None)
    return Solution(
        theta=problem.restore(point.theta),
        residual=problem.restore(point.residual),
        weights=problem.restore(_kernel(point.residual, kappa, scale)),
        objective=problem.restore(quadratic.value),
        n_iter=found.n_iter,
        converged=problem.restore(found.quiet),
        jacobian=_shaped_jacobian(problem, point),
        curvature=problem.restore(quadratic.curvature),
    )


@dataclass(frozen=True)
class _Likelihood:
    """What the E-step needs of a problem: normalised weights (B, N, m) and the total of each channel (B, m)."""

    weight: Tensor | None
    total: Tensor

    def select(self, index: Tensor) -> _Likelihood:
        return _Likelihood(None if self.weight is None else self.weight[index], self.total[index])


def _likelihood(problem: _Problem, residual: Tensor) -> _Likelihood:
    if problem.weight is None:
        count = residual.new_full((residual.shape[0], residual.shape[2]), residual.shape[1])
        return _Likelihood(None, count)
    total = problem.weight.sum(-2)
    return _Likelihood(problem.weight / total.unsqueeze(-2), total)


@dataclass(frozen=True)
class _Maximum:
    point: _Point
    state: DensityState
    value: Tensor  # mean negative log-likelihood and prior, in nats per sample
    converged: Tensor
    n_iter: int
    penalty: _Penalty | None


def _alternate(
    problem: _Problem,
    likelihood: _Likelihood,
    point: _Point,
    state: DensityState,
    *,
    max_iter: int,
    tol: float,
    exact: bool = True,
    penalty: _Penalty | None = None,
) -> _Maximum:
    """E-steps on (σ, d) and damped steps on θ in turn, until they bring less than ``tol`` nats and promise no more."""
    eps = torch.finfo(point.theta.dtype).eps
    share = likelihood.total / likelihood.total.mean(-1, keepdim=True)
    samples = likelihood.total.mean(-1)
    previous = torch.full_like(samples, torch.inf)
    done = torch.zeros_like(samples, dtype=torch.bool)
    stepped = done
    calm = settled = torch.zeros_like(state.value, dtype=torch.bool)
    damping: Tensor | None = None
    n_iter = 0
    while n_iter < max_iter:
        before = state
        state = newton_step(point.residual, likelihood.weight, before)
        value = (share * state.value).sum(-1) + _prior_value(problem, point.theta) / samples
        change = (previous - value).abs() if problem.is_inequality is not None else previous - value
        improved = change > tol + 8 * eps * value.abs()
        # rounding can make a Newton step that has nothing left to gain look like a failed one
        earlier, settled = settled, conclusive(before, state)
        calm = ~improved.unsqueeze(-1) & (calm | settled | earlier)
        done = calm.all(-1) & stepped
        previous = value
        if bool(done.all()):
            break
        kappa, d = state.kappa, torch.exp(state.log_d)
        found, penalty = _constrained(
            problem,
            point,
            kappa,
            d,
            max_iter=1 if penalty is None and problem.is_inequality is None else 30,
            tol=0.0,
            penalty=penalty,
            damping=damping,
            allowance=tol * samples,
            exact=exact,
        )
        n_iter += found.n_iter
        damping, stepped, point = found.damping, found.quiet, found.point
        if found.tired:
            point = problem.refreshed(point)
    return _Maximum(point, state, previous, done, n_iter, penalty)


def _scale(problem: _Problem, point: _Point) -> Float[Tensor, "B m"]:
    """Robust scale of each channel, no less than the rounding error of the residual.

    From the h-th smallest absolute residual, h = (N + p + 1) // 2 with p parameters a channel, since a narrow kernel
    can interpolate p of them; 1 + 5 / (N - p) is the small-sample factor of Rousseeuw & Leroy, Robust Regression and
    Outlier Detection (1987), p. 202, and N / (N - p) stands for the degrees of freedom.
    """
    N, m = point.residual.shape[1:]
    p = math.ceil(point.theta.shape[-1] / m)
    left = max(N - p, 1)
    middle = order_statistic(point.residual.abs(), problem.weight, min((N + p + 1) // 2, N))
    scale = 1.4826 * (1.0 + 5.0 / left) * (N / left) * middle
    reach = torch.matmul(point.theta.abs().unsqueeze(-2), point.tangents.abs()).squeeze(-2)
    magnitude = torch.maximum(reach.unflatten(-1, (N, m)).amax(-2), point.residual.abs().amax(-2))
    eps = torch.finfo(scale.dtype).eps
    return torch.maximum(scale, 1e3 * eps * torch.where(magnitude > 0, magnitude, 1.0))


def _graduated(problem: _Problem, point: _Point, max_iter: int) -> tuple[_Point, int]:
    """Fits with a kernel of many robust scales first and of less than one at last, again while the scale shrinks."""
    n_iter = 0
    last: Tensor | None = None
    for stage in range(16):
        scale = _scale(problem, point)
        if last is not None and stage >= len(_KERNELS) and bool((scale > 0.8 * last).all()):
            break
        last = scale
        kernel = _KERNELS[min(stage, len(_KERNELS) - 1)] * scale
        found, _ = _constrained(
            problem, point, torch.ones_like(scale), kernel, max_iter=max_iter, tol=1e-3, exact=False
        )
        n_iter += found.n_iter
        point = problem.refreshed(found.point) if found.tired else found.point
    return point, n_iter


def _gaussian_candidate(
    problem: _Problem, likelihood: _Likelihood, maximum: _Maximum, *, max_iter: int, tol: float
) -> _Maximum:
    """Where a Gaussian density at weighted least squares is likelier than what was found, go on from there instead."""
    state = maximum.state
    point = problem.refreshed(maximum.point)
    tailed = (state.kappa > 0).any(-1)
    if not bool(tailed.any()):
        return replace(maximum, point=point)
    d_min = torch.exp(state.log_d_min)

    def spread(residual: Tensor) -> Tensor:
        square = residual.square()
        mean = square.mean(-2) if likelihood.weight is None else (likelihood.weight * square).sum(-2)
        return torch.maximum(mean.sqrt(), d_min)

    # the linear model of the residual shows whether the Gaussian stands a chance before any fit is made
    d = spread(point.residual)
    residual = point.residual
    for _ in range(1 if d.shape[-1] == 1 else 2):
        quadratic = _quadratic(problem, point, torch.zeros_like(d), d, None)
        scaling = _positive(quadratic.majoriser.diagonal(dim1=-2, dim2=-1))
        step, _, _ = _step(
            replace(problem, box=None),
            point.theta,
            quadratic.gradient,
            quadratic.majoriser,
            scaling,
            torch.full_like(scaling[:, 0], 1e-9),
        )
        change = torch.matmul(step.unsqueeze(-2), point.tangents).squeeze(-2).unflatten(-1, residual.shape[1:])
        residual = point.residual + change
        d = spread(residual)
    share = likelihood.total / likelihood.total.mean(-1, keepdim=True)
    gaussian = initial_state(
        residual, likelihood.weight, d_min, torch.exp(state.log_bound), d_min, kappa=torch.zeros_like(d_min)
    )
    better = tailed & ((share * gaussian.value).sum(-1) < maximum.value + tol)
    index = better.nonzero().squeeze(-1)
    if index.numel() == 0:
        return replace(maximum, point=point)
    part, part_likelihood = problem.select(index), likelihood.select(index)
    begun = replace(gaussian.select(index), free_kappa=False)
    again = _alternate(part, part_likelihood, point.select(index), begun, max_iter=max_iter, tol=tol)
    freed = replace(again.state, free_kappa=True, damping=torch.full_like(again.state.damping, 1e-3))
    again = _alternate(part, part_likelihood, again.point, freed, max_iter=max_iter, tol=tol, penalty=again.penalty)
    won = (again.value < maximum.value[index]).nonzero().squeeze(-1)
    if won.numel() == 0:
        return replace(maximum, point=point, n_iter=maximum.n_iter + again.n_iter)
    index, winner = index[won], problem.select(index).refreshed(again.point).select(won)
    fields = ("kappa", "log_d", "log_bound", "log_d_min", "damping", "value")
    merged = {f: getattr(state, f).index_copy(0, index, getattr(again.state, f)[won]) for f in fields}
    penalty = maximum.penalty
    if penalty is not None and again.penalty is not None:
        penalty = _Penalty(
            penalty.multiplier.index_copy(0, index, again.penalty.multiplier[won]),
            penalty.rho.index_copy(0, index, again.penalty.rho[won]),
        )
    return _Maximum(
        point=point.write(index, winner),
        state=replace(state, **merged),
        value=maximum.value.index_copy(0, index, again.value[won]),
        converged=maximum.converged.index_copy(0, index, again.converged[won]),
        n_iter=maximum.n_iter + again.n_iter,
        penalty=penalty,
    )


def _covariance(
    problem: _Problem,
    point: _Point,
    kappa: Tensor,
    d: Tensor,
    penalty: _Penalty | None,
    kind: CovarianceKind,
    bandwidth: float | None,
) -> Float[Tensor, "B p p"]:
    """Sandwich in coordinates of column norm 1, within the active bounds and constraints."""
    quadratic = _quadratic(problem, point, kappa, d, None)
    size = _positive(quadratic.majoriser.diagonal(dim1=-2, dim2=-1)).rsqrt()
    curvature = quadratic.curvature * size.unsqueeze(-1) * size.unsqueeze(-2)
    eye = torch.eye(size.shape[-1], dtype=size.dtype, device=size.device)
    held = _active_normals(problem, point, quadratic.gradient, penalty) * size.unsqueeze(-2)
    length = torch.linalg.vector_norm(held, dim=-1, keepdim=True)
    held = held / _positive(length)
    free = eye - torch.matmul(torch.linalg.pinv(held), held)
    curvature = free @ curvature @ free + (eye - free)
    values, vectors = torch.linalg.eigh(curvature)
    eps = torch.finfo(size.dtype).eps
    blind = values.abs() <= 1e3 * eps * values.abs().amax(-1, keepdim=True)
    unknown = (vectors.square() * blind.unsqueeze(-2)).sum(-1) > 1e-6

    precision = d.pow(-2).unsqueeze(-2)
    psi = _kernel(point.residual, kappa, d) * point.residual * precision
    if problem.weight is not None:
        psi = psi * problem.weight
    score = (point.tangents.unflatten(-1, psi.shape[1:]) * psi.unsqueeze(1)).sum(-1).mT
    score = torch.matmul(score * size.unsqueeze(-2), free)
    total = float(psi[0].numel())
    used = torch.full_like(size[:, 0], total) if problem.used is None else problem.used.sum((-2, -1)).to(size)
    left = used - free.diagonal(dim1=-2, dim2=-1).sum(-1).round()
    covariance = sandwich(curvature, score, used / left.clamp(min=1.0), kind, bandwidth)
    if problem.prior_precision is not None:
        # the prior is one more measurement, of its own precision
        inverse = torch.linalg.pinv(curvature, hermitian=True) @ free
        extra = problem.prior_precision * size.unsqueeze(-1) * size.unsqueeze(-2)
        covariance = covariance + inverse @ extra @ inverse.mT
    covariance = free @ covariance @ free * size.unsqueeze(-1) * size.unsqueeze(-2)
    no_errors = (left <= 0) if problem.prior_precision is None else torch.zeros_like(left, dtype=torch.bool)
    lost = unknown | no_errors.unsqueeze(-1)
    return torch.where(lost.unsqueeze(-1) | lost.unsqueeze(-2), torch.inf, covariance)


def _active_normals(problem: _Problem, point: _Point, gradient: Tensor, penalty: _Penalty | None) -> Tensor:
    """Normals (B, k, p) of the bounds and constraints that hold the parameters; 0 for those that do not."""
    B, p = point.theta.shape
    rows = [torch.zeros(B, 1, p, dtype=gradient.dtype, device=gradient.device)]
    if problem.box is not None:
        at = (point.theta <= problem.box[0]) | (point.theta >= problem.box[1])
        rows.append(torch.diag_embed(at.to(gradient.dtype)))
    if penalty is not None and point.constraint is not None and point.normals is not None:
        assert problem.is_inequality is not None
        pulls = ~problem.is_inequality | (penalty.rho * penalty.excess(problem, point.constraint) < 0)
        rows.append(point.normals * pulls.to(gradient.dtype).unsqueeze(-1))
    return torch.cat(rows, -2)


@torch.no_grad()
def fit(
    residual: Residual,
    start: Float[Tensor, "*batch p"],
    *,
    bound: float | Tensor | None = None,
    sigma: float | Tensor | None = None,
    d: float | Tensor | None = None,
    graduate: bool = True,
    data: Any = None,
    weight: Tensor | None = None,
    prior: GaussianPrior | None = None,
    lower: Float[Tensor, " p"] | None = None,
    upper: Float[Tensor, " p"] | None = None,
    equality: Constraint | None = None,
    inequality: Constraint | None = None,
    max_iter: int = 200,
    tol: float = 1e-10,
    jacobian: Literal["forward", "reverse"] = "forward",
    covariance: CovarianceKind | None = "sandwich",
    bandwidth: float | None = None,
) -> NonlinearFit:
    """Parameters, bandwidths and scales of a residual by maximum likelihood of the MKC density: MKC-EM.

    Newton steps on (σ, d) of each channel and a damped step on θ in turn, as in :class:`mkc_torch.linear.MKCRegression`
    and with its safeguards: a domain that stays fixed, d no less than 0.3 robust scales, and a second attempt from
    weighted least squares where a Gaussian is likelier than what was found. A graduated start leads in: fits with a
    kernel of ten robust scales of the residuals and fewer and fewer of them, so that a start from which most residuals
    are large is survived.

    The prior is weighed against the likelihood of all residuals; the E-step does not see it.

    Args:
        residual: as in :func:`minimise`.
        start: (*, p).
        bound: half-width of the domain in the unit of the residual, at least two robust scales: a number, (m,) or
            (*, m); None takes :func:`mkc_torch.density_fit.domain_rule` on a rough robust fit.
        sigma: None learns σ; a value keeps it.
        d: None learns d; a value keeps it.
        graduate: False begins at ``start`` as it is; only for starts near the answer.
        data, weight, prior, lower, upper, equality, inequality, jacobian: as in :func:`minimise`.
        max_iter: trial steps at most in each of the rough and the final fit.
        tol: converged when two alternations in a row each raise the mean log-likelihood by less (nats per sample).
        covariance: "sandwich" for independent samples, "hac" for a time series, None for none. The curvature is the
            objective's, without the residual's second derivatives; the scores of a sample's channels are summed.
        bandwidth: whole lags of "hac", in samples; default by Andrews' rule.

    Raises:
        TypeError, ValueError: as :func:`minimise`, or a domain that the head of the density does not fit in.

    References:
        Li et al., "Multi-kernel Correntropy Regression" (2023), (17), (29)-(31), Algorithm 2.

    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> t = torch.linspace(0, 4, 200, dtype=torch.float64)
        >>> y = 3.0 * torch.exp(-0.7 * t) + 0.05 * torch.randn(200, generator=generator, dtype=torch.float64)
        >>> y[::4] += 2.0
        >>> found = fit(lambda a: (a[0] * torch.exp(-a[1] * t) - y).unsqueeze(-1), torch.tensor([1.0, 0.1]).double())
        >>> [round(v, 1) for v in found.theta.tolist()], bool(found.standard_error().max() < 0.05)
        ([3.0, 0.7], True)
    """
    if max_iter < 1:
        raise ValueError(f"Expected argument `max_iter` to be at least 1 but got {max_iter}.")
    kind = None if covariance is None else checked_kind(covariance)
    checked_bandwidth(bandwidth)
    problem, point = _prepared(
        residual,
        start,
        data=data,
        weight=weight,
        prior=prior,
        lower=lower,
        upper=upper,
        equality=equality,
        inequality=inequality,
        jacobian=jacobian,
    )
    fixed_sigma = None if sigma is None else _channels("sigma", sigma, point.residual, problem.batch, infinite=True)
    fixed_d = None if d is None else _channels("d", d, point.residual, problem.batch, infinite=False)
    fixed_bound = None if bound is None else _channels("bound", bound, point.residual, problem.batch, infinite=False)
    steps = 0
    if graduate:
        point, steps = _graduated(problem, point, max_iter)
    likelihood = _likelihood(problem, point.residual)
    scale = _scale(problem, point)
    d_min = _FLOOR * scale if fixed_d is None else torch.minimum(fixed_d, _FLOOR * scale)

    def begun(at: _Point, size: Tensor, domain: Tensor, tails: Sequence[float | Tensor]) -> DensityState:
        return initial_state(
            at.residual,
            likelihood.weight,
            size,
            domain,
            d_min,
            kappa=None if fixed_sigma is None else fixed_sigma.pow(-2),
            d=fixed_d,
            tails=tails,
        )

    if fixed_bound is None:
        tight = domain_rule(point.residual, scale, problem.used, scales=5.0)
        rough = _alternate(
            problem,
            likelihood,
            point,
            begun(point, scale, tight, (0.1, 0.4, 1.5)),
            max_iter=max_iter,
            tol=1e-4,
            exact=False,
        )
        steps += rough.n_iter
        point = rough.point
        size = torch.exp(rough.state.log_d)
        domain = domain_rule(point.residual, size, problem.used)
        state = begun(point, size, domain, (rough.state.kappa,))
        penalty = rough.penalty
    else:
        refuse_narrow_bound(fixed_bound, scale)
        state = begun(point, scale, fixed_bound, (0.1, 0.4, 1.5))
        penalty = None
    maximum = _alternate(problem, likelihood, point, state, max_iter=max_iter, tol=tol, penalty=penalty)
    if state.free_kappa and state.free_d:
        maximum = _gaussian_candidate(problem, likelihood, maximum, max_iter=max_iter, tol=tol)
    point = problem.refreshed(maximum.point)
    kappa, scale = maximum.state.kappa, torch.exp(maximum.state.log_d)
    found = None
    if kind is not None:
        found = problem.restore(_covariance(problem, point, kappa, scale, maximum.penalty, kind, bandwidth))
    return NonlinearFit(
        theta=problem.restore(point.theta),
        sigma=problem.restore(kappa.rsqrt()),
        d=problem.restore(scale),
        bound=problem.restore(torch.exp(maximum.state.log_bound)),
        log_likelihood=problem.restore(-maximum.state.value.sum(-1)),
        weights=problem.restore(_kernel(point.residual, kappa, scale)),
        residual=problem.restore(point.residual),
        covariance=found,
        jacobian=_shaped_jacobian(problem, point),
        n_iter=steps + maximum.n_iter,
        converged=problem.restore(maximum.converged),
    )
