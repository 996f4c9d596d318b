"""Differentiate a robust fit through its stationarity condition: the gradient of its objective is zero.

The searches, steps and stopping rules of a fit have no useful derivative. Its result θ solves ``g(θ, x) = 0`` for the
data x, so it moves with the data by ``-H⁻¹ ∂g/∂x``, where H is the Hessian of the objective. The expression
``θ - H⁻¹ g(θ, x)`` with constant θ and H has this derivative. Applied once more to its own result, it has the right
second derivatives too: each application removes one order of the error, since ``1 - H⁻¹ ∂g/∂θ`` vanishes at the
solution. Third derivatives are not right. Everything after the search is plain torch, so reverse mode, forward mode and
vmap need no custom rules.

H is the Hessian of the likelihood in the coefficients, σ and d at once; of the coefficients alone it is
``Σ x xᵀ w (1 - z² / σ²) / d²``, not the ``Σ x xᵀ w / d²`` of the fixed point (15).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import forward_ad

from mkc_torch._support.torch_internals import functorch_is_active
from mkc_torch.density.energy import energy, inverse_square
from mkc_torch.density.normalizer import log_partition
from mkc_torch.linear._implicit.refusal import RaisingIdentity
from mkc_torch.linear._implicit.stationary import FitData, FitState, stationary
from mkc_torch.linear._mkc import coefficient_covariance
from mkc_torch.linear._problem import CanonicalShapes, LinearProblem, checked_shapes, linear_problem
from mkc_torch.linear.covariance import CovarianceKind

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_APPLICATIONS = 2
"""Orders of derivatives that are right."""


class GivenParameters(NamedTuple):
    """Parameters given to a fit, each None if it is not: σ, d and domain (*, m), starting coefficients."""

    sigma: Tensor | None
    d: Tensor | None
    bound: Tensor | None
    start: Tensor | None


@dataclass(frozen=True)
class Layer:
    """A differentiable fit in the user's batch dimensions; ``covariance``, ``dof`` and ``extras`` are constants."""

    coef: Float[Tensor, "*batch n"]
    weights: Float[Tensor, "*batch N m"]
    kappa: Float[Tensor, "*batch m"]
    d: Float[Tensor, "*batch m"]
    bound: Float[Tensor, "*batch m"]
    log_likelihood: Float[Tensor, " *batch"] | None
    covariance: Float[Tensor, "*batch n n"]
    dof: Float[Tensor, " *batch"]
    differentiable: Bool[Tensor, " *batch"]
    converged: Bool[Tensor, " *batch"]
    extras: tuple[Tensor, ...]
    single_channel: bool


def needs_derivatives(*values: object) -> bool:
    """Whether derivatives by any of these values are recorded, or a transform of ``torch.func`` is active."""
    if functorch_is_active():
        return True
    return any(
        (torch.is_grad_enabled() and value.requires_grad) or forward_ad.unpack_dual(value).tangent is not None
        for value in values
        if isinstance(value, Tensor)
    )


def fit_layer(
    X: Float[Tensor, "*batch N m n"],
    Y: Float[Tensor, "*batch N m"],
    sample_weight: Float[Tensor, "*batch N"] | None,
    solve: Callable[[LinearProblem, GivenParameters], FitState],
    *,
    sigma: float | Tensor | None,
    d: float | Tensor | None,
    bound: float | Tensor | None = None,
    start: Tensor | None = None,
    covariance: tuple[CovarianceKind, float | None] = ("sandwich", None),
) -> Layer:
    """Fit by ``solve`` with derivatives by X, Y, the weights, and by σ, d and domain where they are given.

    Raises:
        ValueError: bad input, as in :func:`linear_problem`.
    """
    values = checked_shapes(X, Y, sample_weight)
    rank = len(values.batch)
    given = GivenParameters(*(_of_rank(v, rank, values.Y) for v in (sigma, d, bound, start)))
    search = _Search(solve, covariance)
    data = (_with_batch_rank(values.X, rank + 3), values.Y, values.sample_weight)
    found: tuple[Tensor, ...] = _Solve.apply(search, *data, *given)  # type: ignore[no-untyped-call]
    count = len(_SearchResult._fields)
    return _differentiable(values, given, _SearchResult(*found[:count]), found[count:])


def _with_batch_rank(value: Tensor, rank: int) -> Tensor:
    return value.reshape((1,) * (rank - value.dim()) + tuple(value.shape))


def _of_rank(value: float | Tensor | None, rank: int, like: Tensor) -> Tensor | None:
    """Reshape a parameter to all batch dimensions, of size 1 where it lacks them, so that vmap can prepend another."""
    if value is None:
        return None
    t = value.to(like) if isinstance(value, Tensor) else torch.as_tensor(value, dtype=like.dtype, device=like.device)
    return _with_batch_rank(t, rank + 1)


class _SearchResult(NamedTuple):
    """Constants that a search returns, each with the user's batch dimensions in front."""

    to_coef: Float[Tensor, "*#batch n n"]
    beta: Float[Tensor, "*batch n"]
    kappa: Float[Tensor, "*batch m"]
    log_d: Float[Tensor, "*batch m"]
    log_bound: Float[Tensor, "*batch m"]
    unit: Float[Tensor, "*batch 1"]
    total: Float[Tensor, "*batch 1"]
    inverse: Float[Tensor, "*batch p p"]
    cause: Int[Tensor, " *batch"]
    converged: Bool[Tensor, " *batch"]
    covariance: Float[Tensor, "*batch n n"]


class _Search(NamedTuple):
    solve: Callable[[LinearProblem, GivenParameters], FitState]
    covariance: tuple[CovarianceKind, float | None]

    @torch.no_grad()
    def run(self, X: Tensor, Y: Tensor, weight: Tensor | None, given: GivenParameters) -> tuple[Tensor, ...]:
        problem = linear_problem(X, Y, weight)
        fit_state = self.solve(problem, given)
        at = stationary(problem, fit_state)
        shared = problem.to_coef.shape[0] == 1
        lead = (1,) * len(problem.batch) if shared else tuple(problem.batch)
        covariance = coefficient_covariance(problem, at.beta, at.kappa, torch.exp(at.log_d), *self.covariance)
        log_bound = torch.zeros_like(at.log_d) if fit_state.log_bound is None else fit_state.log_bound
        own = (at.beta, at.kappa, at.log_d, log_bound, at.unit, at.total, at.inverse, at.cause, fit_state.converged)
        return (
            problem.to_coef.reshape(lead + tuple(problem.to_coef.shape[1:])),
            *(problem.restore(v) for v in own),
            covariance,
            *(problem.restore(v) for v in fit_state.extras),
        )


class _Solve(torch.autograd.Function):
    """The search; its results are constants to every transform, and vmap adds a batch dimension to its inputs."""

    @staticmethod
    def forward(
        search: _Search,
        X: Tensor,
        Y: Tensor,
        weight: Tensor | None,
        sigma: Tensor | None,
        d: Tensor | None,
        bound: Tensor | None,
        start: Tensor | None,
    ) -> tuple[Tensor, ...]:
        return search.run(X, Y, weight, GivenParameters(sigma, d, bound, start))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:  # noqa: ARG004 - signature of torch.autograd.Function
        ctx.mark_non_differentiable(*output)
        ctx.set_materialize_grads(False)
        ctx.outputs = len(output)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[None, ...]:  # noqa: ARG004 - signature of torch.autograd.Function
        return (None,) * 8

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> tuple[None, ...]:  # noqa: ARG004 - signature of torch.autograd.Function
        return (None,) * ctx.outputs

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[int | None, ...], search: _Search, *inputs: Tensor | None
    ) -> tuple[tuple[Tensor, ...], tuple[int | None, ...]]:
        moved = [
            None if v is None else v.unsqueeze(0) if dim is None else v.movedim(dim, 0)
            for v, dim in zip(inputs, in_dims[1:], strict=True)
        ]
        X, Y, weight, *given = moved
        assert X is not None
        assert Y is not None
        Y = Y.expand(info.batch_size, *Y.shape[1:])
        if weight is not None:
            weight = weight.expand(info.batch_size, *weight.shape[1:])
        found: tuple[Tensor, ...] = _Solve.apply(search, X, Y, weight, *given)  # type: ignore[no-untyped-call]
        to_coef, *others = found
        if to_coef.shape[0] == 1:  # all problems share X, kept once
            return (to_coef.squeeze(0), *others), (None, *(0 for _ in others))
        return found, (0,) * len(found)


def _residual_dof(values: CanonicalShapes) -> Tensor:
    used = torch.ones_like(values.Y) if values.sample_weight is None else (values.sample_weight > 0).to(values.Y.dtype)
    return used.sum((-2, -1)) - values.X.shape[-1]


def _differentiable(
    values: CanonicalShapes, given: GivenParameters, found: _SearchResult, extras: tuple[Tensor, ...]
) -> Layer:
    """Recompute the solution from the data in plain torch: same values, derivatives by two Newton chord steps."""
    rows = torch.matmul(values.X.flatten(-3, -2), found.to_coef)
    likelihood = found.inverse.shape[-1] > found.beta.shape[-1]
    n, m = found.beta.shape[-1], found.kappa.shape[-1]
    shape = found.kappa.shape
    kappa = found.kappa if given.sigma is None else inverse_square(given.sigma).expand(shape)
    log_d = found.log_d if given.d is None else torch.log(given.d).expand(shape)
    log_bound = found.log_bound if given.bound is None else torch.log(given.bound).expand(shape)
    data = FitData(
        rows=rows.reshape(rows.shape[-2:]) if rows.shape[:-2].numel() == 1 else rows,
        Y=values.Y,
        weight=values.sample_weight,
        log_bound=log_bound if likelihood else None,
        unit=found.unit,
        total=found.total,
    )
    beta = found.beta
    for _ in range(_APPLICATIONS):
        gradient = data.gradient(beta, kappa, log_d)
        move = -torch.matmul(found.inverse, gradient.unsqueeze(-1)).squeeze(-1)
        beta = beta + found.unit * move[..., :n]
        if likelihood:
            kappa, log_d = kappa + move[..., n : n + m], log_d + move[..., n + m :]
    unknowns = torch.cat([beta, kappa, log_d], -1)
    unknowns = RaisingIdentity.apply(unknowns, found.cause, "")  # type: ignore[no-untyped-call]
    beta, kappa, log_d = unknowns[..., :n], unknowns[..., n : n + m], unknowns[..., n + m :]
    z = data.residual(beta) * torch.exp(-log_d).unsqueeze(-2)
    log_likelihood = None
    if likelihood:
        counted = values.Y.shape[-2] if values.sample_weight is None else values.sample_weight.sum(-2)
        norm = log_d + log_partition(kappa, torch.exp(log_bound - log_d))
        log_likelihood = -(data.summed(energy(z, kappa.unsqueeze(-2))) + counted * norm).sum(-1)
    return Layer(
        coef=torch.matmul(found.to_coef, beta.unsqueeze(-1)).squeeze(-1),
        weights=torch.exp(-0.5 * kappa.unsqueeze(-2) * z * z),
        kappa=kappa,
        d=torch.exp(log_d),
        bound=torch.exp(log_bound),
        log_likelihood=log_likelihood,
        covariance=found.covariance,
        dof=_residual_dof(values),
        differentiable=found.cause == 0,
        converged=found.converged,
        extras=extras,
        single_channel=values.single_channel,
    )
