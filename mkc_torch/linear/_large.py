"""MKC-EM on many rows: a pilot fit of some of them, then few passes over all, to the maximum of the likelihood of all.

Each pass adds up the exact value and gradient of the likelihood by coefficients, κ and log d at once, and its curvature
by all but pairs of coefficients. Steps are Newton's, with the curvature by coefficients of the pilot until they are
short and of all rows at the end, so that most passes are as cheap as a residual. A step is kept where the likelihood
rises; otherwise an E-step and an M-step are made in its place. The fit is at rest where Newton's step with the
curvature of all rows is less than a millionth of a standard error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch.density.fit import (
    DensityState,
    Derivatives,
    likelihood_derivatives,
    newton_proposal,
)
from mkc_torch.density.normalizer import log_partition_value
from mkc_torch.linear._blocks import (
    Density,
    Matrices,
    Range,
    Sums,
    blocks,
    kernel,
    matrices,
    residual,
    residual_range,
    sums,
)
from mkc_torch.linear._implicit.at_rest import Point, Rest, free_unknowns, inverse_where, moved
from mkc_torch.linear._maximum import Known
from mkc_torch.linear._pilot import Pilot, pilot_fit, pilot_problem
from mkc_torch.linear._problem import MAX_IMPLIED_CHANNELS, CanonicalShapes

if TYPE_CHECKING:
    from jaxtyping import Float, Float64

LARGE = 30_000
"""Values from which a fit begins with a pilot: here both ways take as long."""

_NEAR = 0.03
"""Standard errors from the maximum, below which a pass adds up the curvature of all rows."""

_REST = 1e-6
"""Length in standard errors of the step that a fit at rest would still make."""

_PASSES = 30
"""Passes after which a fit that did not come to rest is left to the alternation over all rows; five are usual."""

_SLACK = 2.0
"""By which the pilot's inverse products are taken larger than they are: they are within a tenth of those of all rows."""

_CONDITION = 1e3
"""Ratio of singular values of X, its columns scaled, up to which sums are formed from its columns as they are."""


def is_large(values: CanonicalShapes) -> bool:
    """Whether a fit of these is for :func:`large_maximum`: one problem of many rows on a processor.

    Elsewhere a block's many small operations take longer than the memory that they spare.
    """
    return (
        values.Y.numel() >= LARGE
        and values.batch.numel() == 1
        and values.Y.shape[-1] <= MAX_IMPLIED_CHANNELS
        and values.Y.device.type == "cpu"
        and not torch.compiler.is_compiling()
    )


@dataclass(frozen=True)
class LargeMaximum:
    """The maximum of the likelihood of all rows, in the user's columns; fields without batch dimensions."""

    coef: Float64[Tensor, " n"]
    kappa: Float64[Tensor, " m"]
    d: Float64[Tensor, " m"]
    bound: Float64[Tensor, " m"]
    weights: Float[Tensor, "N m"]
    log_likelihood: Float64[Tensor, ""]
    covariance: Float64[Tensor, "n n"]
    dof: Float64[Tensor, ""]
    history: Float64[Tensor, " k"]


@dataclass(frozen=True)
class _Rows:
    X: Float[Tensor, "N m n"]
    Y: Float[Tensor, "N m"]
    weight: Float[Tensor, "N m"] | None
    frame: Float64[Tensor, "n n"] | None = None

    def range_at(self, coef: Float64[Tensor, " n"]) -> Range:
        total: Range | None = None
        for block in blocks(self.X, self.Y, self.weight):
            part = residual_range(block, coef)
            total = part if total is None else total.plus(part)
        assert total is not None
        return total

    def look(
        self, point: Point, *, bend: bool = False, weights: Float[Tensor, "N m"] | None = None
    ) -> tuple[Sums, Matrices | None]:
        """One pass at a point: sums, matrices where asked for, and the kernel's weights into ``weights``."""
        density = Density(point.kappa[0], torch.exp(point.log_d[0]))
        total: Sums | None = None
        both: Matrices | None = None
        first = 0
        for block in blocks(self.X, self.Y, self.weight, self.frame):
            error = residual(block, point.beta[0])
            q, w = kernel(error, density)
            part = sums(block, error, q, w, density)
            total = part if total is None else total.plus(part)
            if bend:
                more = matrices(block, error, q, w, density)
                both = more if both is None else both.plus(more)
            if weights is not None:
                weights[first : first + w.shape[0]] = w
                first += w.shape[0]
        assert total is not None
        return total, both


class _System(NamedTuple):
    """Mean negative log-likelihood at a point, with what the next step goes by; coefficients in units of ``unit``."""

    point: Point
    value: float
    per_sample: Tensor
    gradient: Float64[Tensor, "1 p"]
    hessian: Float64[Tensor, "1 p p"]
    by_channel: Derivatives


def _system(rest: Rest, point: Point, total: Sums, curvature: Float64[Tensor, "n n"], unit: Tensor) -> _System:
    assert rest.log_bound is not None
    assert rest.log_d_min is not None
    kappa, log_d = point.kappa[0], point.log_d[0]
    everything = total.weight.sum()
    share = total.weight / everything
    state = _state(rest, point)
    by_channel = likelihood_derivatives(Derivatives(*(total.energy / total.weight).unbind()), state)
    precision = torch.exp(-2.0 * log_d).unsqueeze(-1)
    plain, of_q, _ = total.score * (unit * precision / everything)
    cross = torch.cat([of_q, 2.0 * (plain - kappa.unsqueeze(-1) * of_q)]).mT
    kk, kl, ll = (torch.diag(share * v) for v in by_channel[3:])
    hessian = torch.cat(
        [
            torch.cat([curvature * unit.square(), cross], -1),
            torch.cat([cross.mT, torch.cat([torch.cat([kk, kl], -1), torch.cat([kl, ll], -1)])], -1),
        ]
    )
    gradient = torch.cat([-plain.sum(0), share * by_channel.kappa, share * by_channel.log_d])
    value = by_channel.value
    return _System(
        point, float((share * value).sum()), value.sum(), gradient.unsqueeze(0), hessian.unsqueeze(0), by_channel
    )


def _state(rest: Rest, point: Point) -> DensityState:
    assert rest.log_bound is not None
    assert rest.log_d_min is not None
    blank = torch.full_like(point.kappa[0], 1e-3)
    return DensityState(
        point.kappa[0],
        point.log_d[0],
        rest.log_bound[0],
        rest.log_d_min[0],
        blank,
        blank,
        rest.free_kappa,
        rest.free_d,
    )


class _End(NamedTuple):
    here: _System
    total: Sums
    matrices: Matrices
    history: list[Tensor]


def _descend(
    rows: _Rows,
    rest: Rest,
    curvature: Float64[Tensor, "n n"],
    majoriser: Float64[Tensor, "n n"],
    weights: Float[Tensor, "N m"],
    passes: int,
) -> _End | None:
    """From the pilot's end to the maximum of all rows; None where that takes more than so many passes.

    Args:
        rows: all of them.
        rest: where the pilot ended, with its domain and what is free.
        curvature, majoriser: of the pilot by coefficients, per unit of weight, for Newton's and for the plain step.
        weights: filled with the kernel's weights at the end.
        passes: at most.
    """
    point = Point(rest.beta, rest.kappa, rest.log_d)
    unit = torch.exp(rest.log_d.amin())
    m = point.kappa.shape[-1]
    best: _System | None = None
    found: Matrices | None = None
    history: list[Tensor] = []
    before, near, plain = math.inf, False, False
    move = torch.zeros_like(point.beta)
    for _ in range(passes):
        total, both = rows.look(point, bend=near and found is None, weights=weights if near else None)
        everything = total.weight.sum()
        if both is not None:
            found, curvature = both, both.curvature / everything
        here = _system(rest, point, total, curvature, unit)
        if best is not None and not here.value <= best.value + _rounding(best.value):
            # Newton's step failed: an E-step and an M-step, and parts of them where the pilot's are too long
            move, plain = (0.25 * move, True) if plain else (_plain_move(rest, best, majoriser, unit), True)
            point = moved(rest, best.point, move, unit, m)
            continue
        best = here
        history.append(here.per_sample)
        inverse, strict = inverse_where(here.hessian, free_unknowns(rest, point, here.gradient))
        plain = not bool(strict)
        if plain:
            move = _plain_move(rest, here, majoriser, unit)
        else:
            move = -torch.matmul(inverse, here.gradient.unsqueeze(-1)).squeeze(-1)
            length = math.sqrt(max(0.0, -float((move * here.gradient).sum() * everything)))
            if found is not None and length <= _REST:
                return _End(here, total, found, history)
            rate = 0.1 if math.isinf(before) else min(1.0, length / before)
            near, before = near or length * rate <= _NEAR, length
        point = moved(rest, point, move, unit, m)
    return None


def _rounding(value: float) -> float:
    return 64.0 * torch.finfo(torch.float64).eps * max(1.0, abs(value))


def _plain_move(rest: Rest, at: _System, majoriser: Float64[Tensor, "n n"], unit: Tensor) -> Float64[Tensor, "1 p"]:
    """An M-step and a damped Newton step in κ and log d, each on its own."""
    n = majoriser.shape[0]
    by_beta = -torch.linalg.solve(majoriser * unit.square(), at.gradient[0, :n])
    state = _state(rest, at.point)
    proposal = newton_proposal(at.by_channel, state)
    return torch.cat([by_beta, proposal.kappa - state.kappa, proposal.log_d - state.log_d]).unsqueeze(0)


def _in_frame(pilot: Pilot) -> tuple[Float64[Tensor, "n n"] | None, Float64[Tensor, "n n"]]:
    """The frame that sums are formed in, None for the columns of X; and from the pilot's basis to it.

    Columns that nearly depend on one another, as a time in seconds does on an intercept, lose digits in their products.
    """
    to_coef = pilot.problem.to_coef[0]
    upper = torch.linalg.inv(to_coef)
    singular = torch.linalg.svdvals(upper / upper.square().sum(0).sqrt())
    if float(singular[0]) <= _CONDITION * float(singular[-1]):
        return None, to_coef
    return to_coef, torch.eye(to_coef.shape[0], dtype=to_coef.dtype)


def _gaussian_may_be_likelier(rest: Rest, end: _End, grams: Float64[Tensor, "m n n"], slack: float) -> bool:
    """Whether a Gaussian at least squares can be likelier than the maximum found.

    Least squares lowers the sum of squares of a channel by ``gᵀ G⁻¹ g``, g being the sum of ``e x`` and G that of
    ``x xᵀ``.

    Args:
        rest: domain and least d.
        end: the maximum.
        grams: G of each channel.
        slack: factor by which ``gᵀ G⁻¹ g`` may be larger.
    """
    assert rest.log_bound is not None
    assert rest.log_d_min is not None
    moment = end.total.score[2]
    root = grams.diagonal(dim1=-2, dim2=-1).clamp(min=torch.finfo(grams.dtype).tiny).rsqrt()
    inverse = torch.linalg.pinv(root.unsqueeze(-1) * grams * root.unsqueeze(-2), hermitian=True)
    scaled = (moment * root).unsqueeze(-1)
    lowered = torch.matmul(scaled.mT, torch.matmul(inverse, scaled)).flatten()
    variance = ((end.total.square - slack * lowered) / end.total.weight).clamp(min=0.0)
    d = torch.maximum(variance.sqrt(), torch.exp(rest.log_d_min[0]))
    norm = log_partition_value(torch.zeros_like(d), torch.exp(rest.log_bound[0]) / d)
    return float((torch.log(d) + 0.5 * variance / d.square() + norm).sum()) < float(end.here.per_sample)


def _gaussian_wins(rows: _Rows, rest: Rest, end: _End, grams: Float64[Tensor, "m n n"]) -> bool:
    """:func:`_gaussian_may_be_likelier`, with the products of all rows where those of the pilot do not decide it."""
    if not (rest.free_kappa and rest.free_d) or not bool((end.here.point.kappa > 0).any()):
        return False
    everything = end.total.weight.sum()
    if not _gaussian_may_be_likelier(rest, end, grams * everything, _SLACK):
        return False
    if grams.shape[0] > 1:
        return True
    point = end.here.point
    flat = Point(point.beta, torch.zeros_like(point.kappa), torch.zeros_like(point.log_d))
    _, products = rows.look(flat, bend=True)
    assert products is not None
    return _gaussian_may_be_likelier(rest, end, products.curvature.unsqueeze(0), 1.0)


def large_maximum(values: CanonicalShapes, known: Known, *, max_iter: int, seed: int) -> LargeMaximum | None:
    """The maximum of the likelihood of one problem of many rows.

    None where the values are not finite, where the pilot cannot stand for all rows, or where the passes do not come to
    rest: an alternation over all rows then tells what is wrong, or finds its way.
    """
    X, Y, weight = values.X, values.Y, values.sample_weight
    rows = _Rows(
        X.reshape(X.shape[-3:]), Y.reshape(Y.shape[-2:]), None if weight is None else weight.reshape(weight.shape[-2:])
    )
    if not _sound(rows):
        return None
    problem = pilot_problem(values, seed)
    if problem is None:
        return None

    def half_width(beta: Tensor, scale: Tensor) -> Tensor:
        low, high = rows.range_at(torch.matmul(problem.to_coef[0], beta[0]))
        return torch.maximum(0.5 * (high - low), 10.0 * scale)

    pilot = pilot_fit(problem, known, max_iter=max_iter, seed=seed, half_width=half_width)
    if pilot is None:
        return None
    frame, out_of_basis = _in_frame(pilot)
    into_basis = torch.linalg.inv(out_of_basis)
    curvature, majoriser = (into_basis.mT @ v @ into_basis for v in (pilot.curvature, pilot.majoriser))
    state = pilot.maximum.state
    rest = Rest(
        beta=torch.matmul(pilot.maximum.beta, out_of_basis.mT),
        kappa=state.kappa,
        log_d=state.log_d,
        converged=pilot.maximum.converged,
        log_bound=state.log_bound,
        log_d_min=state.log_d_min,
        free_kappa=state.free_kappa,
        free_d=state.free_d,
    )
    rows = replace(rows, frame=frame)
    weights = torch.empty_like(rows.Y)
    end = _descend(rows, rest, curvature, majoriser, weights, min(max_iter, _PASSES))
    if end is None or _gaussian_wins(rows, rest, end, into_basis.mT @ pilot.grams @ into_basis):
        return None
    point = end.here.point
    used = rows.Y.numel() if rows.weight is None else int((rows.weight > 0).sum())
    left = used - X.shape[-1]
    covariance = _sandwich(end.matrices, used, left)
    coef = point.beta[0]
    if frame is not None:
        coef, covariance = frame @ coef, frame @ covariance @ frame.mT
    return LargeMaximum(
        coef=coef,
        kappa=point.kappa[0],
        d=torch.exp(point.log_d[0]),
        bound=torch.exp(state.log_bound[0]),
        weights=weights,
        log_likelihood=-(end.total.weight * end.here.by_channel.value).sum(),
        covariance=covariance,
        dof=coef.new_tensor(float(left)),
        history=torch.stack(end.history),
    )


def _sandwich(found: Matrices, used: int, left: int) -> Float64[Tensor, "n n"]:
    root = found.curvature.diagonal().rsqrt()
    outer = root.unsqueeze(-1) * root
    inverse = outer * torch.linalg.pinv(outer * found.curvature, hermitian=True)
    return used / max(left, 1) * inverse @ found.spread @ inverse


def _sound(rows: _Rows) -> bool:
    """Whether all values are finite, weights not negative and somewhere positive, and squares of squares of Y in range."""
    if rows.weight is not None:
        least, most = torch.aminmax(rows.weight)
        if not (0.0 <= float(least) and float(most) < math.inf and bool((rows.weight.sum(0) > 0).all())):
            return False
    limit = float(torch.finfo(rows.Y.dtype).max) ** 0.25
    low, high = torch.aminmax(rows.Y)
    largest = max(-float(low), float(high))
    if not 1.0 / limit <= largest <= limit:
        return False
    return all(math.isfinite(float(v)) for v in torch.aminmax(rows.X))
