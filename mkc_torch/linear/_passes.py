"""From near the maximum of the MKC likelihood to it, in few passes over rows of any number.

Each pass adds up the exact value and gradient of the likelihood by coefficients, κ and log d at once, and its curvature
by κ and log d. What else a Newton step needs changes little on the way: it is that of fewer rows until the steps are
short, and of all rows at the end, so that most passes cost little more than a residual. A step is kept where the
likelihood rises; otherwise an E-step and an M-step are made in its place.
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
    bends,
    blocks,
    energy_of,
    kernel,
    residual,
    residual_range,
    sums,
)
from mkc_torch.linear._implicit.stationary import (
    FlatStationaryPoint,
    StationaryPoint,
    free_unknowns,
    inverse_where,
    moved,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jaxtyping import Float, Float64

_FIRST_RATE = 0.1
"""Of what is left after a step, for want of two steps to tell it from."""


@dataclass(frozen=True)
class Rows:
    """Rows of one problem; sums are formed of X times ``frame``, coefficients belong to those columns."""

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

    def look(
        self,
        beta: Float64[Tensor, " n"],
        density: Density,
        *,
        bend: bool = False,
        weights: Float[Tensor, "N m"] | None = None,
    ) -> tuple[Sums, CurvatureSums | None]:
        """One pass: sums, bends where asked for, and the kernel's weights into ``weights``."""
        total: Sums | None = None
        more: CurvatureSums | None = None
        first = 0
        for block in self.blocks():
            error = residual(block, beta)
            q, w = kernel(error, density)
            part = sums(block, error, q, w, density)
            total = part if total is None else total.plus(part)
            if bend:
                bent = bends(block, error, q, w, density)
                more = bent if more is None else more.plus(bent)
            if weights is not None:
                weights[first : first + w.shape[0]] = w
                first += w.shape[0]
        assert total is not None
        return total, more


def density_of(point: FlatStationaryPoint) -> Density:
    return Density(point.kappa[0], torch.exp(point.log_d[0]))


@dataclass(frozen=True)
class PassDerivatives:
    """What a step goes by beside the sums of a pass, per unit of weight: curvature, tilt, products of each channel."""

    curvature: Float64[Tensor, "n n"]
    tilt: Float64[Tensor, "m n"]
    grams: Float64[Tensor, "m n n"]


class EvaluatedPoint(NamedTuple):
    """Mean negative log-likelihood at a point, with its derivatives; coefficients in units of the least d."""

    point: FlatStationaryPoint
    value: float
    per_sample: Float64[Tensor, ""]
    gradient: Float64[Tensor, "1 p"]
    hessian: Float64[Tensor, "1 p p"]
    by_channel: Derivatives


class DescentEnd(NamedTuple):
    """Where a descent ended; ``bends`` are those of the last pass but one or two, if any was to have them."""

    place: EvaluatedPoint
    sums: Sums
    bends: CurvatureSums | None
    history: list[Float64[Tensor, ""]]


def _state(rest: StationaryPoint, point: FlatStationaryPoint) -> DensityState:
    assert rest.log_bound is not None
    assert rest.log_d_min is not None
    kappa, log_d = point.kappa[0], point.log_d[0]
    damping = torch.full_like(kappa, 1e-3)
    return DensityState(
        kappa, log_d, rest.log_bound[0], rest.log_d_min[0], damping, damping, rest.free_kappa, rest.free_d
    )


def _place(
    rest: StationaryPoint, point: FlatStationaryPoint, total: Sums, slopes: PassDerivatives, unit: Tensor
) -> EvaluatedPoint:
    kappa = point.kappa[0].unsqueeze(-1)
    everything = total.weight.sum()
    share = total.weight / everything
    by_channel = likelihood_derivatives(
        Derivatives(*(v / total.weight for v in energy_of(total, point.kappa[0]))), _state(rest, point)
    )
    precision = unit * torch.exp(-2.0 * point.log_d[0]).unsqueeze(-1)
    score, tilt = total.score * precision / everything, slopes.tilt * precision
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


def _newton_move(rest: StationaryPoint, at: EvaluatedPoint) -> Float64[Tensor, "1 p"] | None:
    """Newton's step; what would cross a limit ends there, and the others step accordingly. None at no convex place."""
    assert rest.log_bound is not None
    assert rest.log_d_min is not None
    kappa, log_d = at.point.kappa, at.point.log_d
    open_end = torch.full_like(at.point.beta, math.inf)
    low = torch.cat([-open_end, -kappa, rest.log_d_min - log_d], -1)
    high = torch.cat([open_end, KAPPA_MAX - kappa, rest.log_bound - log_d], -1)
    keep = free_unknowns(rest, at.point, at.gradient)
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


def _represented(point: FlatStationaryPoint, slopes: PassDerivatives, everything: Tensor) -> float:
    """Length in standard errors of a change of every coefficient by four units in its last place."""
    spread = (slopes.curvature.diagonal().clamp(min=0.0) * point.beta[0].square()).sum()
    return 4.0 * torch.finfo(torch.float64).eps * math.sqrt(float(everything * spread))


def _plain_move(
    rest: StationaryPoint, at: EvaluatedPoint, slopes: PassDerivatives, unit: Tensor
) -> Float64[Tensor, "1 p"]:
    """An M-step with weights of 1, which is no longer than one with the kernel's, and a damped step in κ and log d."""
    precision = torch.exp(-2.0 * at.point.log_d[0])[:, None, None]
    gram = (slopes.grams * precision).sum(0) * unit.square()
    by_beta = -torch.linalg.solve(gram, at.gradient[0, : gram.shape[0]])
    state = _state(rest, at.point)
    proposal = newton_proposal(at.by_channel, state)
    return torch.cat([by_beta, proposal.kappa - state.kappa, proposal.log_d - state.log_d]).unsqueeze(0)


def _slack(value: float, rounding: float, everything: Tensor) -> float:
    """What rounding makes of the mean likelihood, of its sum and of residuals that are small beside the targets."""
    return 64.0 * torch.finfo(torch.float64).eps * max(1.0, abs(value)) + rounding / float(everything)


def descend(
    rows: Rows,
    rest: StationaryPoint,
    slopes: PassDerivatives,
    *,
    near: float,
    stop: float,
    passes: int,
    weights: Float[Tensor, "N m"] | None = None,
    first: Sums | None = None,
    alike: bool = True,
) -> DescentEnd | None:
    """To where Newton's step with the curvature of these rows is short; None where that takes too many passes.

    Args:
        rows: whose likelihood is maximised.
        rest: where to begin, with the domain and what is free.
        slopes: to step by at first, of other rows.
        near: standard errors from the maximum, below which a pass adds up the curvature of these rows; at 0 none does.
        stop: length of the last step in standard errors; it is told, not made.
        passes: at most.
        weights: filled with the kernel's weights at the end.
        first: the sums where it begins, if they are known.
        alike: whether the slopes' rows are like these; otherwise the first pass, too, adds up their curvature.
    """
    point = FlatStationaryPoint(rest.beta, rest.kappa, rest.log_d)
    unit = torch.exp(rest.log_d.amin())
    m = point.kappa.shape[-1]
    best: EvaluatedPoint | None = None
    found: CurvatureSums | None = None
    history: list[Tensor] = []
    before, left, plain = math.inf, math.inf, False
    move = torch.zeros_like(point.beta)
    for _ in range(passes):
        close = found is not None or left < near
        if first is None or close:
            bend = not alike or (close and found is None)
            total, more = rows.look(point.beta[0], density_of(point), bend=bend, weights=weights if close else None)
        else:
            total, more, first = first, None, None
        everything = total.weight.sum()
        if more is not None:
            alike, found = True, more if close else None
            slopes = PassDerivatives(more.curvature / everything, more.tilt / everything, slopes.grams)
        here = _place(rest, point, total, slopes, unit)
        rounding = _represented(point, slopes, everything)
        if best is not None and not here.value <= best.value + _slack(best.value, rounding, everything):
            # Newton's step failed: a plain one, and parts of it where that fails too
            move, plain = (0.25 * move if plain else _plain_move(rest, best, slopes, unit)), True
            point = moved(rest, best.point, move, unit, m)
            continue
        best = here
        history.append(here.per_sample)
        newton = _newton_move(rest, here)
        plain = newton is None
        if newton is None:
            move = _plain_move(rest, here, slopes, unit)
        else:
            move = newton
            length = math.sqrt(max(0.0, -float((move * here.gradient).sum() * everything)))
            if (found is not None or near == 0.0) and length <= max(stop, rounding):
                return DescentEnd(here, total, found, history)
            left = length * (_FIRST_RATE if math.isinf(before) else min(1.0, length / before))
            before = length
        point = moved(rest, point, move, unit, m)
    return None
