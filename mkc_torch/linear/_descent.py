"""Maximise the MKC likelihood from a nearby point in few passes over any number of rows.

Each pass sums the exact value and gradient of the likelihood by coefficients, κ and log d, and its curvature by κ and
log d. The rest of the Hessian changes little on the way: it comes from fewer rows until the steps are short, and from
all rows at the end, so most passes cost little more than a residual. A step is accepted if the likelihood rises;
otherwise an E-step and an M-step replace it. Where the rows are, and how their sums are formed, is left to the caller.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch.density.energy import KAPPA_MAX
from mkc_torch.density.likelihood import DensityState, Derivatives, likelihood_derivatives, newton_proposal
from mkc_torch.linear._blocks import CurvatureSums, Density, PassResult, energy_of
from mkc_torch.linear._implicit.stationary import FitState, Unknowns, free_unknowns, inverse_where, moved

if TYPE_CHECKING:
    from jaxtyping import Float64

_FIRST_RATE = 0.1
"""Assumed convergence rate after the first step, when no two steps are known to estimate it from."""


class PassDerivatives(NamedTuple):
    """Derivatives from other rows, per unit of weight: curvature, tilt, products of each channel."""

    curvature: Float64[Tensor, "n n"]
    tilt: Float64[Tensor, "m n"]
    grams: Float64[Tensor, "m n n"]

    @staticmethod
    def of(result: PassResult, grams: Float64[Tensor, "m n n"]) -> PassDerivatives:
        """The derivatives at the point of a pass with curvature."""
        assert result.curvature is not None
        unit = result.total.weight.sum()
        return PassDerivatives(result.curvature.curvature / unit, result.curvature.tilt / unit, grams)


class EvaluatedPoint(NamedTuple):
    """Mean negative log-likelihood at a point, with its derivatives; coefficients in units of the least d."""

    point: Unknowns
    value: float
    per_sample: float
    gradient: Float64[Tensor, "1 p"]
    hessian: Float64[Tensor, "1 p p"]
    by_channel: Derivatives
    result: PassResult


def _state(fit_state: FitState, point: Unknowns) -> DensityState:
    kappa, log_d, (least, bound) = point.kappa[0], point.log_d[0], fit_state.limits
    damping = torch.full_like(kappa, 1e-3)
    free = fit_state.free_kappa, fit_state.free_d
    return DensityState(kappa, log_d, bound[0], least[0], damping, damping, *free)


def _evaluated_point(
    fit_state: FitState, point: Unknowns, result: PassResult, slopes: PassDerivatives, unit: Tensor
) -> EvaluatedPoint:
    total, kappa = result.total, point.kappa[0].unsqueeze(-1)
    total_weight = total.weight.sum()
    share = total.weight / total_weight
    by_channel = likelihood_derivatives(
        Derivatives(*(v / total.weight for v in energy_of(total, point.kappa[0]))), _state(fit_state, point)
    )
    precision = unit * torch.exp(-2.0 * point.log_d[0]).unsqueeze(-1)
    score, tilt = total.score * precision / total_weight, slopes.tilt * precision
    cross = torch.cat([tilt, 2.0 * (score - kappa * tilt)])
    kk, kl, ll = (torch.diag(share * v) for v in by_channel[3:])
    hessian = torch.cat(
        [
            torch.cat([slopes.curvature * unit.square(), cross.mT], -1),
            torch.cat([cross, torch.cat([torch.cat([kk, kl], -1), torch.cat([kl, ll], -1)])], -1),
        ]
    )
    gradient = torch.cat([-score.sum(0), share * by_channel.kappa, share * by_channel.log_d])
    value = by_channel.value
    mean, summed = float((share * value).sum()), float(value.sum())
    return EvaluatedPoint(point, mean, summed, gradient.unsqueeze(0), hessian.unsqueeze(0), by_channel, result)


def _newton_move(fit_state: FitState, at: EvaluatedPoint) -> Float64[Tensor, "1 p"] | None:
    """Newton step, with components that would cross a limit stopped there; None where the Hessian is not positive."""
    kappa, log_d, (least, bound) = at.point.kappa, at.point.log_d, fit_state.limits
    open_end = torch.full_like(at.point.beta, math.inf)
    low = torch.cat([-open_end, -kappa, least - log_d], -1)
    high = torch.cat([open_end, KAPPA_MAX - kappa, bound - log_d], -1)
    keep = free_unknowns(fit_state, at.point, at.gradient)
    fixed = torch.zeros_like(at.gradient)
    while True:
        inverse, strict = inverse_where(at.hessian, keep)
        if not bool(strict):
            return None
        slope = at.gradient + torch.matmul(at.hessian, fixed.unsqueeze(-1)).squeeze(-1)
        move = fixed - torch.matmul(inverse, slope.unsqueeze(-1)).squeeze(-1)
        beyond = keep & ((move < low) | (move > high))
        if not bool(beyond.any()):
            return move
        fixed = torch.where(beyond, torch.minimum(torch.maximum(move, low), high), fixed)
        keep = keep & ~beyond


def _rounding_length(point: Unknowns, slopes: PassDerivatives, total_weight: Tensor) -> float:
    """Length in standard errors of a change of every coefficient by four units in its last place."""
    spread = (slopes.curvature.diagonal().clamp(min=0.0) * point.beta[0].square()).sum()
    return 4.0 * torch.finfo(torch.float64).eps * math.sqrt(float(total_weight * spread))


def _plain_move(
    fit_state: FitState, at: EvaluatedPoint, slopes: PassDerivatives, unit: Tensor
) -> Float64[Tensor, "1 p"]:
    """M-step with weights 1, never longer than that with the true weights, and a damped step in κ and log d."""
    precision = torch.exp(-2.0 * at.point.log_d[0])[:, None, None]
    gram = (slopes.grams * precision).sum(0) * unit.square()
    by_beta = -torch.linalg.solve(gram, at.gradient[0, : gram.shape[0]])
    state = _state(fit_state, at.point)
    proposal = newton_proposal(at.by_channel, state)
    return torch.cat([by_beta, proposal.kappa - state.kappa, proposal.log_d - state.log_d]).unsqueeze(0)


def _slack(value: float, rounding: float, total_weight: Tensor) -> float:
    """Rounding error of the mean likelihood, from its sum and from residuals that are small compared to the targets."""
    return 64.0 * torch.finfo(torch.float64).eps * max(1.0, abs(value)) + rounding / float(total_weight)


@dataclass(frozen=True)
class Descent:
    """State of a descent between two passes: start it with a point and call :meth:`after` with the sums of each pass.

    Attributes:
        fit_state: the start, with the domain and the free unknowns.
        slopes: derivatives of other rows for the first steps.
        point: the point of the next pass.
        near: distance from the maximum, in standard errors, below which a pass computes the curvature; 0: never.
        stop: length in standard errors of the Newton step with the curvature of these rows at which the descent ends;
            ``move`` is that step, which is not made.
        fresh: whether the last pass has to compute the curvature; otherwise that of an earlier pass is used.
        slow: largest ratio of the lengths of successive steps; above it, the next pass computes the curvature.
        slopes_valid: whether ``slopes`` represent all rows; otherwise the next pass computes the curvature.
        best: the accepted point of least value.
        curvature_sums: sums of the last pass near the maximum that computed the curvature.
        length, left: length of the last step and expected length of the next, in standard errors.
        move: the last step.
        plain: whether the last step was an E-step and an M-step.
        history: mean negative log-likelihood, summed over the channels, at every accepted point.
        done: whether the descent has ended.
    """

    fit_state: FitState
    slopes: PassDerivatives
    point: Unknowns
    near: float
    stop: float
    fresh: bool = False
    slow: float = math.inf
    slopes_valid: bool = True
    best: EvaluatedPoint | None = None
    curvature_sums: CurvatureSums | None = None
    length: float = math.inf
    left: float = math.inf
    move: Float64[Tensor, "1 p"] | None = None
    plain: bool = False
    history: tuple[float, ...] = ()
    done: bool = False

    @staticmethod
    def begin(fit_state: FitState, slopes: PassDerivatives, **options: float) -> Descent:
        point = Unknowns(fit_state.beta, fit_state.kappa, fit_state.log_d)
        return Descent(fit_state, slopes, point, **options)  # type: ignore[arg-type]

    @property
    def unit(self) -> Tensor:
        """Unit of the coefficients in gradient, Hessian and steps."""
        return torch.exp(self.fit_state.log_d.amin())

    @property
    def close(self) -> bool:
        """Whether the next pass may be the last."""
        return self.left < self.near or (self.curvature_sums is not None and not self.fresh)

    @property
    def with_curvature(self) -> bool:
        """Whether the next pass computes the curvature."""
        return not self.slopes_valid or (self.close and (self.fresh or self.curvature_sums is None))

    def density(self) -> Density:
        """κ and d of the next pass."""
        return Density(self.point.kappa[0], torch.exp(self.point.log_d[0]))

    def after(self, result: PassResult, slack: float = 0.0) -> Descent:
        """State after the pass at ``point``, from its sums; ``slack`` is their error in the mean likelihood."""
        total, more = result.total, result.curvature
        total_weight, close = total.weight.sum(), self.close
        now = self
        if more is not None:
            now = replace(self, slopes=PassDerivatives.of(result, self.slopes.grams), slopes_valid=True)
        if more is not None or self.fresh:
            now = replace(now, curvature_sums=more if close else None)
        here = _evaluated_point(now.fit_state, now.point, result, now.slopes, now.unit)
        rounding = _rounding_length(now.point, now.slopes, total_weight)
        best = now.best
        if best is not None and not here.value <= best.value + _slack(best.value, rounding, total_weight) + slack:
            return now._shorter_step(best)
        now = replace(now, best=here, history=(*now.history, here.per_sample))
        move = _newton_move(now.fit_state, here)
        if move is None:
            return now._moved(here, _plain_move(now.fit_state, here, now.slopes, now.unit), plain=True)
        length = math.sqrt(max(0.0, -float((move * here.gradient).sum() * total_weight)))
        if (now.curvature_sums is not None or now.near == 0.0) and length <= max(now.stop, rounding):
            return replace(now, move=move, length=length, done=True)
        rate = _FIRST_RATE if math.isinf(now.length) else min(1.0, length / now.length)
        slow = rate > now.slow and more is None and not math.isinf(now.length)
        return replace(now, left=length * rate, length=length, slopes_valid=not slow)._moved(here, move, plain=False)

    @property
    def end(self) -> tuple[EvaluatedPoint, CurvatureSums]:
        """The best point, and the curvature sums, of a descent that is done."""
        assert self.best is not None
        assert self.curvature_sums is not None
        return self.best, self.curvature_sums

    def stepped(self) -> Unknowns:
        """The point after the step at which the descent ended."""
        assert self.move is not None
        return moved(self.fit_state, self.end[0].point, self.move, self.unit, self.point.kappa.shape[-1])

    def _moved(self, start: EvaluatedPoint, move: Tensor, *, plain: bool) -> Descent:
        m = self.point.kappa.shape[-1]
        point = moved(self.fit_state, start.point, move, self.unit, m)
        return replace(self, move=move, plain=plain, point=point)

    def _shorter_step(self, best: EvaluatedPoint) -> Descent:
        """After a failed step: a plain step from the best point, then shorter plain steps."""
        if self.plain and self.move is not None:
            return self._moved(best, 0.25 * self.move, plain=True)
        move = _plain_move(self.fit_state, best, self.slopes, self.unit)
        return replace(self, slopes_valid=math.isinf(self.slow))._moved(best, move, plain=True)
