"""Differentiate a robust fit by what holds at its end: the gradient of its objective is zero.

A fit is found by searches, steps and stops that have no useful derivative. Its result θ solves ``g(θ, x) = 0`` for the
data x, so near the data at hand it moves by ``-H⁻¹ ∂g/∂x`` with H the Hessian of the objective. That is what
``θ - H⁻¹ g(θ, x)`` has for a derivative when θ and H are constants. Applied once more to its own result it has the
right second derivatives too: each application removes one order of the error, since ``1 - H⁻¹ ∂g/∂θ`` vanishes at the
solution. Third derivatives are not right. Everything after the search is plain torch, so reverse and forward mode and
vmap need no rules of their own.

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

from mkc_torch.density_fit import _energy_derivatives, _normaliser_derivatives
from mkc_torch.functional import (
    KAPPA_MAX,
    _log_partition_and_slopes,
    energy,
    energy_dkappa,
    energy_dz,
    inverse_square,
    log_partition,
)
from mkc_torch.linear._mkc import coefficient_covariance
from mkc_torch.linear._problem import CanonicalShapes, LinearProblem, laid_out, linear_problem
from mkc_torch.linear.covariance import CovarianceKind

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_POLISHING_STEPS = 12

_APPLICATIONS = 2
"""Orders of derivatives that are right."""


class NotDifferentiableError(ValueError):
    """A derivative was asked for of a fit that is no strict minimum, or that did not come to rest."""


class Given(NamedTuple):
    """What a fit is given beside the data, None where it is not: σ, d and domain (*, m), coefficients to start from."""

    sigma: Tensor | None
    d: Tensor | None
    bound: Tensor | None
    start: Tensor | None


@dataclass(frozen=True)
class Rest:
    """Where a fit came to rest, in the basis of its problem and flat batch dimensions.

    With ``log_bound`` the objective is the negative log-likelihood, in which κ and log d are free where the flags say
    so; without, it is the loss (13) at the given κ and d. ``extras`` are results that the fit passes on.
    """

    beta: Float[Tensor, "B n"]
    kappa: Float[Tensor, "B m"]
    log_d: Float[Tensor, "B m"]
    converged: Bool[Tensor, " B"]
    log_bound: Float[Tensor, "B m"] | None = None
    log_d_min: Float[Tensor, "B m"] | None = None
    free_kappa: bool = False
    free_d: bool = False
    extras: tuple[Tensor, ...] = ()


@dataclass(frozen=True)
class Layer:
    """A differentiable fit in the user's batch dimensions; ``covariance`` and ``extras`` are constants."""

    coef: Float[Tensor, "*batch n"]
    weights: Float[Tensor, "*batch N m"]
    kappa: Float[Tensor, "*batch m"]
    d: Float[Tensor, "*batch m"]
    bound: Float[Tensor, "*batch m"]
    log_likelihood: Float[Tensor, " *batch"] | None
    covariance: Float[Tensor, "*batch n n"]
    differentiable: Bool[Tensor, " *batch"]
    converged: Bool[Tensor, " *batch"]
    extras: tuple[Tensor, ...]
    single_channel: bool


def wanted(*values: object) -> bool:
    """Whether derivatives by any of these are being recorded, or a transform of ``torch.func`` is at work."""
    if torch._C._are_functorch_transforms_active():
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
    solve: Callable[[LinearProblem, Given], Rest],
    *,
    sigma: float | Tensor | None,
    d: float | Tensor | None,
    bound: float | Tensor | None = None,
    start: Tensor | None = None,
    covariance: tuple[CovarianceKind, float | None] = ("sandwich", None),
) -> Layer:
    """A fit with derivatives by X, Y, the weights, and σ, d and domain where they are given.

    Args:
        X, Y, sample_weight: as in :func:`linear_problem`.
        solve: the fit, from checked constants.
        sigma, d, bound: a number, (m,) or (*, m); None is found by the fit.
        start: coefficients (n,) or (*, n) to start from, or None.
        covariance: kind and bandwidth of the covariance of the coefficients.

    Raises:
        ValueError: bad input, as in :func:`linear_problem`.
    """
    values = laid_out(X, Y, sample_weight)
    rank = len(values.batch)
    given = Given(*(_of_rank(v, rank, values.Y) for v in (sigma, d, bound, start)))
    search = _Search(solve, covariance)
    data = (_with_batch_rank(values.X, rank + 3), values.Y, values.sample_weight)
    found: tuple[Tensor, ...] = _Solve.apply(search, *data, *given)  # type: ignore[no-untyped-call]
    count = len(_Found._fields)
    return _differentiable(values, given, _Found(*found[:count]), found[count:])


def _with_batch_rank(value: Tensor, rank: int) -> Tensor:
    return value.reshape((1,) * (rank - value.dim()) + tuple(value.shape))


def _of_rank(value: float | Tensor | None, rank: int, like: Tensor) -> Tensor | None:
    """A parameter with all the batch dimensions, of size 1 where it has none of its own, so that one more can lead."""
    if value is None:
        return None
    t = value.to(like) if isinstance(value, Tensor) else torch.as_tensor(value, dtype=like.dtype, device=like.device)
    return _with_batch_rank(t, rank + 1)


class _Found(NamedTuple):
    """Constants that a search hands over, each with the user's batch dimensions in front."""

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
    solve: Callable[[LinearProblem, Given], Rest]
    covariance: tuple[CovarianceKind, float | None]

    @torch.no_grad()
    def run(self, X: Tensor, Y: Tensor, weight: Tensor | None, given: Given) -> tuple[Tensor, ...]:
        problem = linear_problem(X, Y, weight)
        rest = self.solve(problem, given)
        at = _at_rest(problem, rest)
        shared = problem.to_coef.shape[0] == 1
        lead = (1,) * len(problem.batch) if shared else tuple(problem.batch)
        covariance = coefficient_covariance(problem, at.beta, at.kappa, torch.exp(at.log_d), *self.covariance)
        own = (
            at.beta,
            at.kappa,
            at.log_d,
            torch.zeros_like(at.log_d) if rest.log_bound is None else rest.log_bound,
            at.unit,
            at.total,
            at.inverse,
            at.cause,
            rest.converged,
        )
        return (
            problem.to_coef.reshape(lead + tuple(problem.to_coef.shape[1:])),
            *(problem.restore(v) for v in own),
            covariance,
            *(problem.restore(v) for v in rest.extras),
        )


class _Solve(torch.autograd.Function):
    """The search itself, whose results are constants to every transform; vmap hands it one batch dimension more."""

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
        return search.run(X, Y, weight, Given(sigma, d, bound, start))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:  # noqa: ARG004
        ctx.mark_non_differentiable(*output)
        ctx.set_materialize_grads(False)
        ctx.outputs = len(output)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[None, ...]:  # noqa: ARG004
        return (None,) * 8

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> tuple[None, ...]:  # noqa: ARG004
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
        if to_coef.shape[0] == 1:  # one X for all, kept once
            return (to_coef.squeeze(0), *others), (None, *(0 for _ in others))
        return found, (0,) * len(found)


class _Refusing(torch.autograd.Function):
    """The identity, whose derivative is refused for problems with a cause against it.

    Backward refuses only what is asked for: a problem left out of the loss has a gradient of zeros.
    """

    @staticmethod
    def forward(value: Tensor, cause: Tensor, check: str) -> Tensor:
        refused = cause != 0
        if check and bool(refused.any()):
            asked = refused & (value != 0).any(-1) if check == "asked" else refused
            if _somewhere(asked):
                raise NotDifferentiableError(_refusal(cause, refused))
        return value.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, str], output: Tensor) -> None:  # noqa: ARG004
        ctx.save_for_backward(inputs[1])
        ctx.save_for_forward(inputs[1])

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        return _Refusing.apply(grad, ctx.saved_tensors[0], "asked"), None, None  # type: ignore[no-untyped-call]

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, *_: None) -> Tensor:
        result: Tensor = _Refusing.apply(tangent, ctx.saved_tensors[0], "all")  # type: ignore[no-untyped-call]
        return result

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[int | None, int | None, None], value: Tensor, cause: Tensor, check: str
    ) -> tuple[Tensor, int]:
        size = info.batch_size
        value, cause = (
            v.expand(size, *v.shape) if dim is None else v.movedim(dim, 0)
            for v, dim in zip((value, cause), in_dims[:2], strict=True)
        )
        return _Refusing.apply(value, cause, check), 0  # type: ignore[no-untyped-call]


def _somewhere(mask: Tensor) -> bool:
    try:
        return bool(mask.any())
    except RuntimeError:  # gradients batched by autograd itself have no one value
        return True


_NOT_AT_REST, _NO_MINIMUM = 1, 2


def _refusal(cause: Tensor, refused: Tensor) -> str:
    first = tuple(int(i) for i in refused.nonzero()[0])
    which = f"problem {', '.join(map(str, first))}" if first else "a fit"
    leave_out = ", or leave the problem out of the loss by `differentiable_`" if first else ""
    if int(cause[first]) == _NOT_AT_REST:
        return f"Expected a fit at rest to differentiate but got {which} short of it; raise `max_iter`{leave_out}."
    return (
        f"Expected a strict minimum to differentiate at but got {which} where the Hessian of the objective is singular "
        "or not positive definite, so that its result follows the data in no smooth way; take more samples, or a "
        f"larger `sigma` or `d` where they are given{leave_out}."
    )


@dataclass(frozen=True)
class _Data:
    """What the gradient of the objective depends on; rows are one (K, n) for all problems where they share X."""

    rows: Float[Tensor, "*#batch K n"]
    Y: Float[Tensor, "*batch N m"]
    weight: Float[Tensor, "*batch N m"] | None
    log_bound: Float[Tensor, "*batch m"] | None
    unit: Float[Tensor, "*batch 1"]
    total: Float[Tensor, "*batch 1"]

    def residual(self, beta: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch N m"]:
        if self.rows.dim() == 2:
            fitted = torch.matmul(beta, self.rows.mT)
        else:
            fitted = torch.matmul(self.rows, beta.unsqueeze(-1)).squeeze(-1)
        return self.Y - fitted.unflatten(-1, self.Y.shape[-2:])

    def summed(self, values: Float[Tensor, "*batch N m"]) -> Float[Tensor, "*batch m"]:
        return (values if self.weight is None else self.weight * values).sum(-2)

    def gradient(self, beta: Tensor, kappa: Tensor, log_d: Tensor) -> Float[Tensor, "*batch p"]:
        """Of the mean objective, by the coefficients in units of ``unit`` and, for a likelihood, κ and log d."""
        precision = torch.exp(-log_d)
        z, k = self.residual(beta) * precision.unsqueeze(-2), kappa.unsqueeze(-2)
        influence = energy_dz(z, k)
        score = influence * (self.unit * precision).unsqueeze(-2)
        score = (score if self.weight is None else self.weight * score).flatten(-2)
        if self.rows.dim() == 2:
            by_beta = torch.matmul(score, self.rows)
        else:
            by_beta = torch.matmul(score.unsqueeze(-2), self.rows).squeeze(-2)
        if self.log_bound is None:
            return -by_beta / self.total
        counted = self.Y.shape[-2] if self.weight is None else self.weight.sum(-2)
        length = torch.exp(self.log_bound - log_d)
        _, by_kappa, by_length = _log_partition_and_slopes(kappa, length, energy)
        of_kappa = self.summed(energy_dkappa(z, k)) + counted * by_kappa
        of_log_d = counted * (1.0 - length * by_length) - self.summed(z * influence)
        return torch.cat([-by_beta, of_kappa, of_log_d], -1) / self.total


@dataclass(frozen=True)
class _Point:
    beta: Float[Tensor, "B n"]
    kappa: Float[Tensor, "B m"]
    log_d: Float[Tensor, "B m"]


@dataclass(frozen=True)
class _AtRest(_Point):
    unit: Float[Tensor, "B 1"]
    total: Float[Tensor, "B 1"]
    inverse: Float[Tensor, "B p p"]
    cause: Int[Tensor, " B"]


def _at_rest(problem: LinearProblem, rest: Rest) -> _AtRest:
    """Newton steps to where the gradient is rounding, with the inverse Hessian there; as it was where that fails."""
    size, m = rest.kappa.shape
    rows = problem.basis.flatten(-3, -2)
    unit = torch.exp(rest.log_d.amin(-1, keepdim=True))
    data = _Data(
        rows=rows[0] if rows.shape[0] == 1 else rows,
        Y=problem.Y,
        weight=problem.sample_weight,
        log_bound=rest.log_bound,
        unit=unit,
        total=problem.total_weight().sum(-1, keepdim=True),
    )
    eps = torch.finfo(unit.dtype).eps
    point = _Point(rest.beta, rest.kappa, rest.log_d)
    rounding = (10 * eps * problem.Y.abs().amax((-2, -1)) / unit.squeeze(-1)).square()
    before = rounding.new_full((size,), torch.inf)
    for step in range(_POLISHING_STEPS + 1):
        gradient = data.gradient(point.beta, point.kappa, point.log_d)
        hessian, head = _hessian(problem, data, point)
        keep = _free(rest, point, gradient)
        inverse, strict = _inverse_where(hessian, keep)
        move = -torch.matmul(inverse, torch.where(keep, gradient, 0.0).unsqueeze(-1)).squeeze(-1)
        # what a step would still gain, in mean squares of the fitted values in d
        gain = -(move * gradient).sum(-1)
        near = gain <= eps * head + rounding
        done = ~strict | (near & ((gain <= (1e4 * eps) ** 2 * head) | (gain >= 0.25 * before)))
        if bool(done.all()) or step == _POLISHING_STEPS:
            break
        point, before = _moved(rest, point, torch.where(done.unsqueeze(-1), 0.0, move), unit, m), gain
    cause = torch.where(strict | ~rest.converged, torch.where(near & rest.converged, 0, _NOT_AT_REST), _NO_MINIMUM)
    refused = (cause != 0).unsqueeze(-1)
    return _AtRest(
        beta=torch.where(refused, rest.beta, point.beta),
        kappa=torch.where(refused, rest.kappa, point.kappa),
        log_d=torch.where(refused, rest.log_d, point.log_d),
        unit=unit,
        total=data.total,
        inverse=torch.where(refused.unsqueeze(-1), 0.0, inverse),
        cause=cause,
    )


def _hessian(problem: LinearProblem, data: _Data, point: _Point) -> tuple[Float[Tensor, "B p p"], Float[Tensor, " B"]]:
    """Of the objective whose gradient :class:`_Data` gives, and the mean square of z under the kernel's weights."""
    kappa, log_d = point.kappa, point.log_d
    error = data.residual(point.beta)
    precision = torch.exp(-log_d)
    ratio = (data.unit * precision).unsqueeze(-2)
    z, k = error * precision.unsqueeze(-2), kappa.unsqueeze(-2)
    w = torch.exp(-0.5 * k * z * z)
    wz2 = w * z * z
    head = data.summed(wz2).sum(-1) / data.total.squeeze(-1)
    gram, _ = problem.normal_equations((w - k * wz2) * ratio.square())
    total = data.total.unsqueeze(-1)
    if data.log_bound is None:
        return gram / total, head

    def cross(values: Tensor) -> Float[Tensor, "B n m"]:
        weighted = values if data.weight is None else data.weight * values
        return torch.einsum("bkm,bkmn->bnm", weighted * ratio, problem.basis) / total

    by_kappa, by_log_d = cross(0.5 * wz2 * z), cross(2.0 * w * z - k * wz2 * z)
    share = problem.total_weight() / data.total
    normalised = None if data.weight is None else data.weight / data.weight.sum(-2, keepdim=True)
    fit = _energy_derivatives(error, normalised, kappa, log_d)
    norm = _normaliser_derivatives(kappa, log_d, data.log_bound)
    kk = torch.diag_embed(share * (fit.kappa_kappa + norm.kappa_kappa))
    kl = torch.diag_embed(share * (fit.kappa_log_d + norm.kappa_log_d))
    ll = torch.diag_embed(share * (fit.log_d_log_d + norm.log_d_log_d))
    rows = (
        torch.cat([gram / total, by_kappa, by_log_d], -1),
        torch.cat([by_kappa.mT, kk, kl], -1),
        torch.cat([by_log_d.mT, kl, ll], -1),
    )
    return torch.cat(rows, -2), head


def _free(rest: Rest, point: _Point, gradient: Float[Tensor, "B p"]) -> Bool[Tensor, "B p"]:
    """The unknowns that follow the data: not those given, nor those that a bound holds back."""
    coefficients = torch.ones_like(point.beta, dtype=torch.bool)
    if rest.log_bound is None or rest.log_d_min is None:
        return coefficients
    n, m = point.beta.shape[-1], point.kappa.shape[-1]
    g_kappa, g_log_d = gradient[:, n : n + m], gradient[:, n + m :]
    held_kappa = ((point.kappa <= 0) & (g_kappa >= 0)) | ((point.kappa >= KAPPA_MAX) & (g_kappa <= 0))
    held_d = ((point.log_d <= rest.log_d_min) & (g_log_d >= 0)) | ((point.log_d >= rest.log_bound) & (g_log_d <= 0))
    return torch.cat([coefficients, ~held_kappa & rest.free_kappa, ~held_d & rest.free_d], -1)


def _inverse_where(hessian: Tensor, keep: Tensor) -> tuple[Float[Tensor, "B p p"], Bool[Tensor, " B"]]:
    """Inverse of the Hessian of the unknowns kept, 0 for the others, and whether it is safely positive definite."""
    both = keep.unsqueeze(-1) & keep.unsqueeze(-2)
    hessian = torch.where(both, hessian, torch.diag_embed((~keep).to(hessian.dtype)))
    diagonal = hessian.diagonal(dim1=-2, dim2=-1)
    root = torch.where(diagonal > 0, diagonal, 1.0).rsqrt()
    outer = root.unsqueeze(-1) * root.unsqueeze(-2)
    factor, info = torch.linalg.cholesky_ex(outer * hessian)
    pivots = factor.diagonal(dim1=-2, dim2=-1).square().amin(-1)
    strict = (info == 0) & (pivots > 1e2 * hessian.shape[-1] * torch.finfo(hessian.dtype).eps)
    safe = torch.where(strict[:, None, None], factor, torch.eye(factor.shape[-1]).to(factor))
    inverse = outer * torch.cholesky_inverse(safe)
    return torch.where(both & strict[:, None, None], inverse, 0.0), strict


def _moved(rest: Rest, point: _Point, move: Float[Tensor, "B p"], unit: Tensor, m: int) -> _Point:
    n = point.beta.shape[-1]
    beta = point.beta + unit * move[:, :n]
    if rest.log_bound is None or rest.log_d_min is None:
        return _Point(beta, point.kappa, point.log_d)
    kappa = (point.kappa + move[:, n : n + m]).clamp(0.0, KAPPA_MAX) if rest.free_kappa else point.kappa
    log_d = point.log_d + move[:, n + m :]
    bounded = torch.minimum(torch.maximum(log_d, rest.log_d_min), rest.log_bound)
    return _Point(beta, kappa, bounded if rest.free_d else point.log_d)


def _differentiable(values: CanonicalShapes, given: Given, found: _Found, extras: tuple[Tensor, ...]) -> Layer:
    """The solution again, in plain torch from the data: found values, derivatives by two chord steps of Newton."""
    rows = torch.matmul(values.X.flatten(-3, -2), found.to_coef)
    likelihood = found.inverse.shape[-1] > found.beta.shape[-1]
    n, m = found.beta.shape[-1], found.kappa.shape[-1]
    shape = found.kappa.shape
    kappa = found.kappa if given.sigma is None else inverse_square(given.sigma).expand(shape)
    log_d = found.log_d if given.d is None else torch.log(given.d).expand(shape)
    log_bound = found.log_bound if given.bound is None else torch.log(given.bound).expand(shape)
    data = _Data(
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
    unknowns = _Refusing.apply(unknowns, found.cause, "")  # type: ignore[no-untyped-call]
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
        differentiable=found.cause == 0,
        converged=found.converged,
        extras=extras,
        single_channel=values.single_channel,
    )
