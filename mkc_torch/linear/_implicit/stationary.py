"""Polishing of a fit to a stationary point by Newton steps, and the inverse Hessian of its objective there."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.side_by_side import steps_between_tests
from mkc_torch._support.small_factors import definite_inverse
from mkc_torch.density.energy import KAPPA_MAX, energy, energy_dkappa, energy_dz
from mkc_torch.density.likelihood import DensityState, energy_derivatives, normaliser_derivatives
from mkc_torch.density.normalizer import _log_partition_and_slopes
from mkc_torch.linear._implicit.refusal import _NO_MINIMUM, _NOT_CONVERGED
from mkc_torch.linear._problem import LinearProblem

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_POLISHING_STEPS = 12
"""Largest number of Newton steps that polish a fit."""


@dataclass(frozen=True)
class FitState:
    """Unknowns of a fit, their limits and which of them are free, in the problem's basis and flat batch dimensions.

    With ``log_bound`` the objective is the negative log-likelihood, in which κ and log d are free according to the
    flags. Without, it is the loss (13) at the given κ and d. ``extras`` are further results of the fit.
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

    @staticmethod
    def of(beta: Tensor, state: DensityState, converged: Tensor, extras: tuple[Tensor, ...] = ()) -> FitState:
        """Coefficients and a density fitted to their residuals."""
        limits, free = (state.log_bound, state.log_d_min), (state.free_kappa, state.free_d)
        return FitState(beta, state.kappa, state.log_d, converged, *limits, *free, extras)

    @property
    def limits(self) -> tuple[Tensor, Tensor]:
        """Least log d, and log of the domain, of a likelihood."""
        assert self.log_d_min is not None
        assert self.log_bound is not None
        return self.log_d_min, self.log_bound

    def to(self, device: torch.device) -> FitState:
        """The same on a device; ``extras`` stay where they are."""
        names = ("beta", "kappa", "log_d", "converged", "log_bound", "log_d_min")
        moved_fields = {name: value.to(device) for name in names if (value := getattr(self, name)) is not None}
        return replace(self, **moved_fields)


@dataclass(frozen=True)
class FitData:
    """Data of the gradient of the objective; ``rows`` is a single (K, n) for all problems that share X."""

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
        """Gradient of the mean objective by the coefficients in ``unit`` and, for a likelihood, by κ and log d."""
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
class Unknowns:
    """Coefficients, κ and log d."""

    beta: Float[Tensor, "B n"]
    kappa: Float[Tensor, "B m"]
    log_d: Float[Tensor, "B m"]


@dataclass(frozen=True)
class _StationaryPoint(Unknowns):
    unit: Float[Tensor, "B 1"]
    total: Float[Tensor, "B 1"]
    inverse: Float[Tensor, "B p p"]
    cause: Int[Tensor, " B"]


def stationary(problem: LinearProblem, fit_state: FitState) -> _StationaryPoint:
    """Polish by Newton steps until the gradient is rounding; where that fails, keep the fit and return a cause."""
    size, m = fit_state.kappa.shape
    rows = problem.basis.flatten(-3, -2)
    unit = torch.exp(fit_state.log_d.amin(-1, keepdim=True))
    data = FitData(
        rows=rows[0] if rows.shape[0] == 1 else rows,
        Y=problem.Y,
        weight=problem.sample_weight,
        log_bound=fit_state.log_bound,
        unit=unit,
        total=problem.total_weight().sum(-1, keepdim=True),
    )
    eps = torch.finfo(unit.dtype).eps
    point = Unknowns(fit_state.beta, fit_state.kappa, fit_state.log_d)
    rounding = (10 * eps * problem.Y.abs().amax((-2, -1)) / unit.squeeze(-1)).square()
    before = rounding.new_full((size,), torch.inf)
    every = steps_between_tests(unit)
    for step in range(_POLISHING_STEPS + 1):
        gradient = data.gradient(point.beta, point.kappa, point.log_d)
        hessian, head = _hessian(problem, data, point)
        keep = free_unknowns(fit_state, point, gradient)
        inverse, strict = inverse_where(hessian, keep)
        move = -torch.matmul(inverse, torch.where(keep, gradient, 0.0).unsqueeze(-1)).squeeze(-1)
        # predicted gain of a further step, in mean squares of the fitted values in units of d
        gain = -(move * gradient).sum(-1)
        near = gain <= eps * head + rounding
        done = ~strict | (near & ((gain <= (1e4 * eps) ** 2 * head) | (gain >= 0.25 * before)))
        if step == _POLISHING_STEPS or (step % every == 0 and bool(done.all())):
            break
        point, before = moved(fit_state, point, torch.where(done.unsqueeze(-1), 0.0, move), unit, m), gain
    cause = torch.where(
        strict | ~fit_state.converged, torch.where(near & fit_state.converged, 0, _NOT_CONVERGED), _NO_MINIMUM
    )
    refused = (cause != 0).unsqueeze(-1)
    return _StationaryPoint(
        beta=torch.where(refused, fit_state.beta, point.beta),
        kappa=torch.where(refused, fit_state.kappa, point.kappa),
        log_d=torch.where(refused, fit_state.log_d, point.log_d),
        unit=unit,
        total=data.total,
        inverse=torch.where(refused.unsqueeze(-1), 0.0, inverse),
        cause=cause,
    )


def _hessian(
    problem: LinearProblem, data: FitData, point: Unknowns
) -> tuple[Float[Tensor, "B p p"], Float[Tensor, " B"]]:
    """Hessian of the objective of :class:`FitData`, and the mean square of z under the weights."""
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
    fit = energy_derivatives(error, normalised, kappa, log_d)
    norm = normaliser_derivatives(kappa, log_d, data.log_bound)
    kk = torch.diag_embed(share * (fit.kappa_kappa + norm.kappa_kappa))
    kl = torch.diag_embed(share * (fit.kappa_log_d + norm.kappa_log_d))
    ll = torch.diag_embed(share * (fit.log_d_log_d + norm.log_d_log_d))
    rows = (
        torch.cat([gram / total, by_kappa, by_log_d], -1),
        torch.cat([by_kappa.mT, kk, kl], -1),
        torch.cat([by_log_d.mT, kl, ll], -1),
    )
    return torch.cat(rows, -2), head


def free_unknowns(fit_state: FitState, point: Unknowns, gradient: Float[Tensor, "B p"]) -> Bool[Tensor, "B p"]:
    """Mask of the unknowns that are estimated and not held at a limit."""
    coefficients = torch.ones_like(point.beta, dtype=torch.bool)
    if fit_state.log_bound is None or fit_state.log_d_min is None:
        return coefficients
    n, m = point.beta.shape[-1], point.kappa.shape[-1]
    g_kappa, g_log_d = gradient[:, n : n + m], gradient[:, n + m :]
    held_kappa = ((point.kappa <= 0) & (g_kappa >= 0)) | ((point.kappa >= KAPPA_MAX) & (g_kappa <= 0))
    held_d = ((point.log_d <= fit_state.log_d_min) & (g_log_d >= 0)) | (
        (point.log_d >= fit_state.log_bound) & (g_log_d <= 0)
    )
    return torch.cat([coefficients, ~held_kappa & fit_state.free_kappa, ~held_d & fit_state.free_d], -1)


def inverse_where(hessian: Tensor, keep: Tensor) -> tuple[Float[Tensor, "B p p"], Bool[Tensor, " B"]]:
    """Inverse Hessian of the unknowns in ``keep``, 0 for the others, and whether it is safely positive definite."""
    both = keep.unsqueeze(-1) & keep.unsqueeze(-2)
    hessian = torch.where(both, hessian, torch.diag_embed((~keep).to(hessian.dtype)))
    diagonal = hessian.diagonal(dim1=-2, dim2=-1)
    root = torch.where(diagonal > 0, diagonal, 1.0).rsqrt()
    outer = root.unsqueeze(-1) * root.unsqueeze(-2)
    inverse, strict = definite_inverse(outer * hessian)
    return torch.where(both & strict[:, None, None], outer * inverse, 0.0), strict


def moved(fit_state: FitState, point: Unknowns, move: Float[Tensor, "B p"], unit: Tensor, m: int) -> Unknowns:
    n = point.beta.shape[-1]
    beta = point.beta + unit * move[:, :n]
    if fit_state.log_bound is None or fit_state.log_d_min is None:
        return Unknowns(beta, point.kappa, point.log_d)
    kappa = (point.kappa + move[:, n : n + m]).clamp(0.0, KAPPA_MAX) if fit_state.free_kappa else point.kappa
    log_d = point.log_d + move[:, n + m :]
    bounded = torch.minimum(torch.maximum(log_d, fit_state.log_d_min), fit_state.log_bound)
    return Unknowns(beta, kappa, bounded if fit_state.free_d else point.log_d)
