"""Maximise the MKC likelihood from a nearby point in few passes over any number of rows.

Each pass sums the exact value and gradient of the likelihood by coefficients, κ and log d, and its curvature by κ and
log d. The rest of the Hessian changes little on the way: it comes from fewer rows until the steps are short, and from
all rows at the end, so most passes cost little more than a residual. A step is accepted if the likelihood rises;
otherwise an E-step and an M-step replace it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch.density.energy import KAPPA_MAX
from mkc_torch.density.likelihood import DensityState, Derivatives, likelihood_derivatives, newton_proposal
from mkc_torch.linear._blocks import (
    Block,
    CurvatureSums,
    Density,
    ResidualRange,
    Sums,
    blocks,
    curvature_sums,
    energy_of,
    kernel,
    residual,
    residual_range,
    sums,
)
from mkc_torch.linear._implicit.stationary import (
    FitState,
    Unknowns,
    free_unknowns,
    inverse_where,
    moved,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jaxtyping import Float, Float64

_FIRST_RATE = 0.1
"""Assumed convergence rate after the first step, when no two steps are known to estimate it from."""


@dataclass(frozen=True)
class Rows:
    """Rows of one problem; sums are formed of X times ``frame``, and coefficients refer to those columns."""

    X: Float[Tensor, "N m n"]
    Y: Float[Tensor, "N m"]
    weight: Float[Tensor, "N m"] | None
    frame: Float64[Tensor, "n n"] | None = None

    def blocks(self) -> Iterator[Block]:
        return blocks(self.X, self.Y, self.weight, self.frame)

    def range_at(self, coef: Float64[Tensor, " n"]) -> ResidualRange:
        total: ResidualRange | None = None
        for block in self.blocks():
            part = residual_range(block, coef)
            total = part if total is None else total.plus(part)
        assert total is not None
        return total

    def evaluate(
        self,
        beta: Float64[Tensor, " n"],
        density: Density,
        *,
        with_curvature: bool = False,
        weights: Float[Tensor, "N m"] | None = None,
    ) -> tuple[Sums, CurvatureSums | None]:
        """Make one pass: return the sums and, if wanted, the curvature sums; write the weights to ``weights``."""
        total: Sums | None = None
        more: CurvatureSums | None = None
        first = 0
        for block in self.blocks():
            error = residual(block, beta)
            q, w = kernel(error, density)
            part = sums(block, error, q, w, density)
            total = part if total is None else total.plus(part)
            if with_curvature:
                part_curvature = curvature_sums(block, error, q, w, density)
                more = part_curvature if more is None else more.plus(part_curvature)
            if weights is not None:
                weights[first : first + w.shape[0]] = w
                first += w.shape[0]
        assert total is not None
        return total, more


def density_of(point: Unknowns) -> Density:
    return Density(point.kappa[0], torch.exp(point.log_d[0]))


@dataclass(frozen=True)
class PassDerivatives:
    """Derivatives from other rows, per unit of weight: curvature, tilt, products of each channel."""

    curvature: Float64[Tensor, "n n"]
    tilt: Float64[Tensor, "m n"]
    grams: Float64[Tensor, "m n n"]


class EvaluatedPoint(NamedTuple):
    """Mean negative log-likelihood at a point, with its derivatives; coefficients in units of the least d."""

    point: Unknowns
    value: float
    per_sample: Float64[Tensor, ""]
    gradient: Float64[Tensor, "1 p"]
    hessian: Float64[Tensor, "1 p p"]
    by_channel: Derivatives


class DescentEnd(NamedTuple):
    """End of a descent; ``curvature_sums`` are from one of the last passes, or None if no pass computed them."""

    place: EvaluatedPoint
    sums: Sums
    curvature_sums: CurvatureSums | None
    history: list[Float64[Tensor, ""]]


def _state(fit_state: FitState, point: Unknowns) -> DensityState:
    assert fit_state.log_bound is not None
    assert fit_state.log_d_min is not None
    kappa, log_d = point.kappa[0], point.log_d[0]
    damping = torch.full_like(kappa, 1e-3)
    return DensityState(
        kappa,
        log_d,
        fit_state.log_bound[0],
        fit_state.log_d_min[0],
        damping,
        damping,
        fit_state.free_kappa,
        fit_state.free_d,
    )


def _place(fit_state: FitState, point: Unknowns, total: Sums, slopes: PassDerivatives, unit: Tensor) -> EvaluatedPoint:
    kappa = point.kappa[0].unsqueeze(-1)
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
    return EvaluatedPoint(
        point, float((share * value).sum()), value.sum(), gradient.unsqueeze(0), hessian.unsqueeze(0), by_channel
    )


def _newton_move(fit_state: FitState, at: EvaluatedPoint) -> Float64[Tensor, "1 p"] | None:
    """Newton step, with components that would cross a limit stopped there; None where the Hessian is not positive."""
    assert fit_state.log_bound is not None
    assert fit_state.log_d_min is not None
    kappa, log_d = at.point.kappa, at.point.log_d
    open_end = torch.full_like(at.point.beta, math.inf)
    low = torch.cat([-open_end, -kappa, fit_state.log_d_min - log_d], -1)
    high = torch.cat([open_end, KAPPA_MAX - kappa, fit_state.log_bound - log_d], -1)
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


def descend(
    rows: Rows,
    fit_state: FitState,
    slopes: PassDerivatives,
    *,
    near: float,
    stop: float,
    passes: int,
    weights: Float[Tensor, "N m"] | None = None,
    first: Sums | None = None,
    alike: bool = True,
) -> DescentEnd | None:
    """Iterate until the Newton step with the curvature of these rows is short; None if that takes too many passes.

    Args:
        rows: rows whose likelihood is maximised.
        fit_state: starting point, with the domain and the free unknowns.
        slopes: derivatives of other rows for the first steps.
        near: distance from the maximum, in standard errors, below which a pass computes the curvature; 0: never.
        stop: length of the last step in standard errors; that step is not made.
        passes: largest number of passes.
        weights: filled with the weights at the end.
        first: sums at the starting point, if known.
        alike: whether ``slopes`` are of similar rows; otherwise the first pass computes the curvature too.
    """
    point = Unknowns(fit_state.beta, fit_state.kappa, fit_state.log_d)
    unit = torch.exp(fit_state.log_d.amin())
    m = point.kappa.shape[-1]
    best: EvaluatedPoint | None = None
    found: CurvatureSums | None = None
    history: list[Tensor] = []
    before, left, plain = math.inf, math.inf, False
    move = torch.zeros_like(point.beta)
    for _ in range(passes):
        close = found is not None or left < near
        if first is None or close:
            with_curvature = not alike or (close and found is None)
            total, more = rows.evaluate(
                point.beta[0], density_of(point), with_curvature=with_curvature, weights=weights if close else None
            )
        else:
            total, more, first = first, None, None
        total_weight = total.weight.sum()
        if more is not None:
            alike, found = True, more if close else None
            slopes = PassDerivatives(more.curvature / total_weight, more.tilt / total_weight, slopes.grams)
        here = _place(fit_state, point, total, slopes, unit)
        rounding = _rounding_length(point, slopes, total_weight)
        if best is not None and not here.value <= best.value + _slack(best.value, rounding, total_weight):
            # the Newton step failed: try a plain step, then shorter plain steps
            move, plain = (0.25 * move if plain else _plain_move(fit_state, best, slopes, unit)), True
            point = moved(fit_state, best.point, move, unit, m)
            continue
        best = here
        history.append(here.per_sample)
        newton = _newton_move(fit_state, here)
        plain = newton is None
        if newton is None:
            move = _plain_move(fit_state, here, slopes, unit)
        else:
            move = newton
            length = math.sqrt(max(0.0, -float((move * here.gradient).sum() * total_weight)))
            if (found is not None or near == 0.0) and length <= max(stop, rounding):
                return DescentEnd(here, total, found, history)
            left = length * (_FIRST_RATE if math.isinf(before) else min(1.0, length / before))
            before = length
        point = moved(fit_state, point, move, unit, m)
    return None
