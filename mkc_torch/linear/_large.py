"""MKC-EM on many rows: a pilot fit of few of them, a fit of more of them by Newton steps, and so of all.

Each begins where the last ended and steps by the curvature found there, so that the passes over all rows are few; four
or five are usual. The last ends where a Newton step with the curvature of all rows would be less than a millionth of a
standard error long.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.density.domain import WIDE
from mkc_torch.density.likelihood import DensityState
from mkc_torch.density.normalizer import log_partition_value
from mkc_torch.linear._blocks import CurvatureSums, Density, Sums
from mkc_torch.linear._implicit.stationary import StationaryPoint
from mkc_torch.linear._maximum import TIGHT, FixedParameters, least_d, rough_fit
from mkc_torch.linear._passes import DescentEnd, PassDerivatives, Rows, descend
from mkc_torch.linear._pilot import drawn_rows, pilot_problem, rows_at
from mkc_torch.linear._problem import MAX_IMPLIED_CHANNELS, CanonicalShapes, LinearProblem
from mkc_torch.linear._robust_start import RobustStart, robust_start

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jaxtyping import Float, Float64

LARGE = 20_000
"""Values from which a fit begins with a pilot: of so many rows of nine columns that is four times as fast."""

_GROWTH = 16
"""Of the rows from one fit to the next: each begins some ten of its standard errors from its maximum."""

_AHEAD = 8
"""Times the rows of a fit on the way that there are in all: of fewer, passes over all cost less than one more fit."""

_NEAR, _REST = 0.03, 1e-6
"""Standard errors from the maximum of all rows where their curvature is added up, and where the fit is at rest."""

_NEAR_ON_THE_WAY, _REST_ON_THE_WAY = 0.5, 0.5
"""The same of a fit of fewer rows, whose standard errors are four of those of the next."""

_PASSES = 15
"""Passes after which a fit that did not come to rest is left to the alternation over all rows."""

_WIDEST = 2.0
"""Robust scales of the start up to which a rough fit's d is the head's, and not that of a Gaussian over outliers."""

_TAILS = (0.1, 0.2, 0.4, 1.5)
"""κ that it begins with: one more than otherwise, for a step of the alternation costs more than a look at it."""

_FOR_SLOPES = 8
"""Times the rows of the pilot from which the curvature to step by is: each step leaves a twentieth of the way."""

_CONDITION = 1e3
"""Ratio of singular values of X, its columns scaled, up to which sums are formed from its columns as they are."""

_SLACK = 2.0
"""Factor of a bound on what least squares gains, for the products of the pilot's rows are not quite those of all."""


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


def in_its_basis(problem: LinearProblem) -> CanonicalShapes:
    """A problem whose X is the basis of another."""
    basis, batch = problem.basis, problem.batch
    if basis.shape[0] == 1:
        basis = basis.expand(batch.numel(), *basis.shape[1:])
    weight = problem.sample_weight
    return CanonicalShapes(
        basis.reshape(*batch, *basis.shape[1:]),
        problem.Y.reshape(*batch, *problem.Y.shape[1:]),
        None if weight is None else weight.reshape(*batch, *weight.shape[1:]),
        batch,
        problem.single_channel,
    )


@dataclass(frozen=True)
class LargeMaximum:
    """The maximum of the likelihood of all rows, in the columns of X; ``rest`` is a batch of it, the others are not."""

    coef: Float64[Tensor, " n"]
    rest: StationaryPoint
    weights: Float[Tensor, "N m"]
    log_likelihood: Float64[Tensor, ""]
    covariance: Float64[Tensor, "n n"]
    dof: Float64[Tensor, ""]
    history: Float64[Tensor, " k"]


def large_maximum(values: CanonicalShapes, known: FixedParameters, *, max_iter: int, seed: int) -> LargeMaximum | None:
    """The maximum of the likelihood of one problem of many rows.

    None where the values are not finite, where no pilot stands for all rows or its rough fit finds no head, where most
    values are fitted exactly or d ends at its least, where a Gaussian is likelier than what was found, or where the
    passes do not come to rest: an alternation over all rows then tells what is wrong, or finds its way.
    """
    rows, passes = _rows_of(values), min(max_iter, _PASSES)
    pilot = _pilot(values, known, max_iter, seed) if _sound(rows) else None
    if pilot is None:
        return None
    rows, rest = replace(rows, frame=pilot.frame), pilot.rest
    # rows drawn by leverage say nothing of the curvature of all, and seldom rows may be missing among others
    count = pilot.problem.num_samples
    slopes = _slopes(_drawn(values, _FOR_SLOPES * count, pilot.frame, seed) if pilot.alike else rows, rest)
    if known.bound is None:
        rest = replace(rest, log_bound=torch.log(_half_width(rows, rest.beta, TIGHT * pilot.begin.scale)))
    for some in _on_the_way(values, count, pilot.frame, seed) if pilot.alike else ():
        end = descend(some, rest, slopes, near=_NEAR_ON_THE_WAY, stop=_REST_ON_THE_WAY, passes=passes)
        if end is None or end.bends is None:
            return None
        rest, everything = _moved(rest, end), end.sums.weight.sum()
        slopes = replace(slopes, curvature=end.bends.curvature / everything, tilt=end.bends.tilt / everything)
    first: Sums | None = None
    if known.bound is None:
        end = descend(rows, rest, slopes, near=0.0, stop=1.0, passes=passes) if pilot.alike else None
        if end is not None:
            rest, first = _moved(rest, end), end.sums
        rest, first = _on_its_domain(rows, pilot, known, rest, first)
    weights = torch.empty_like(rows.Y)
    end = descend(
        rows, rest, slopes, near=_NEAR, stop=_REST, passes=passes, weights=weights, first=first, alike=pilot.alike
    )
    if end is None or end.bends is None or _pinned(end, rest) or _gaussian_is_likelier(rows, rest, end, slopes.grams):
        return None
    return _told(rows, rest, end, end.bends, weights)


@dataclass(frozen=True)
class _Pilot:
    """A rough fit of few rows, at ``rest`` in the frame of :class:`Rows`; ``alike`` where any could be among them."""

    problem: LinearProblem
    alike: bool
    begin: RobustStart
    frame: Float64[Tensor, "n n"] | None
    rest: StationaryPoint

    def in_basis(self, beta: Float64[Tensor, "1 n"]) -> Float64[Tensor, "1 n"]:
        """Coefficients in the basis of the pilot's problem."""
        return beta if self.frame is not None else torch.linalg.solve(self.problem.to_coef[0], beta.mT).mT


def _pilot(values: CanonicalShapes, known: FixedParameters, max_iter: int, seed: int) -> _Pilot | None:
    drawn = pilot_problem(values, seed)
    if drawn is None:
        return None
    problem, alike = drawn
    begin = robust_start(problem, known.start, seed=seed, pilot=True)
    if bool(begin.exact.any()):
        return None
    rough = rough_fit(problem, known, begin, max_iter=max_iter, tails=_TAILS)
    learned = known.sigma is None and known.d is None
    if learned and bool((torch.exp(rough.state.log_d) > _WIDEST * begin.scale).any()):
        return None
    frame = _frame(problem)
    beta = rough.beta if frame is not None else torch.matmul(rough.beta, problem.to_coef[0].mT)
    return _Pilot(problem, alike, begin, frame, _at(beta, rough.state))


def _on_its_domain(
    rows: Rows, pilot: _Pilot, known: FixedParameters, rough: StationaryPoint, first: Sums | None
) -> tuple[StationaryPoint, Sums | None]:
    """Where to begin on the domain of the rule, with the sums there where they are those of the rough fit."""
    d = torch.exp(rough.log_d)
    bound = _half_width(rows, rough.beta, WIDE * d)
    beta = pilot.in_basis(rough.beta)
    state = known.initial_state(pilot.problem, beta, d, bound, least_d(pilot.begin), tails=(rough.kappa,))
    if torch.allclose(state.kappa, rough.kappa) and torch.allclose(state.log_d, rough.log_d):
        return replace(rough, log_bound=state.log_bound), first
    return _at(rough.beta, state), None


def _on_the_way(values: CanonicalShapes, count: int, frame: Float64[Tensor, "n n"] | None, seed: int) -> Iterator[Rows]:
    """More and more rows drawn by chance."""
    count *= _GROWTH
    while _AHEAD * count < values.Y.shape[-2]:
        yield _drawn(values, count, frame, seed)
        count *= _GROWTH


def _drawn(values: CanonicalShapes, count: int, frame: Float64[Tensor, "n n"] | None, seed: int) -> Rows:
    return replace(_rows_of(rows_at(values, drawn_rows(values, count, seed + count))), frame=frame)


def _half_width(rows: Rows, beta: Float64[Tensor, "1 n"], least: Float64[Tensor, "1 m"]) -> Float64[Tensor, "1 m"]:
    """That of :func:`domain_rule` for the residuals of all rows."""
    low, high = rows.range_at(beta[0])
    return torch.maximum(0.5 * (high - low), least)


def _moved(rest: StationaryPoint, end: DescentEnd) -> StationaryPoint:
    point = end.place.point
    return replace(rest, beta=point.beta, kappa=point.kappa, log_d=point.log_d)


def _rows_of(values: CanonicalShapes) -> Rows:
    X, Y, weight = values.X, values.Y, values.sample_weight
    weight = None if weight is None else weight.reshape(weight.shape[-2:])
    return Rows(X.reshape(X.shape[-3:]), Y.reshape(Y.shape[-2:]), weight)


def _sound(rows: Rows) -> bool:
    """Whether all values are finite, weights fit, and squares of squares of Y neither overflow nor vanish."""
    if rows.weight is not None:
        least, most = (float(v) for v in torch.aminmax(rows.weight))
        if not (least >= 0.0 and most < math.inf and bool((rows.weight.sum(0) > 0).all())):
            return False
    limit = float(torch.finfo(rows.Y.dtype).max) ** 0.25
    low, high = (float(v) for v in torch.aminmax(rows.Y))
    return 1.0 / limit <= max(-low, high) <= limit and all(math.isfinite(float(v)) for v in torch.aminmax(rows.X))


def _pinned(end: DescentEnd, rest: StationaryPoint) -> bool:
    """Whether d ended at its least, which is that of the pilot's rows."""
    assert rest.log_d_min is not None
    return rest.free_d and bool((end.place.point.log_d <= rest.log_d_min).any())


def _frame(problem: LinearProblem) -> Float64[Tensor, "n n"] | None:
    """The pilot's basis where columns of X nearly depend on one another, as a time in seconds does on an intercept.

    Their products would lose the digits that tell them apart.
    """
    upper = torch.linalg.inv(problem.to_coef[0])
    singular = torch.linalg.svdvals(upper / upper.square().sum(0).sqrt())
    return None if float(singular[0]) <= _CONDITION * float(singular[-1]) else problem.to_coef[0]


def _at(beta: Float64[Tensor, "1 n"], state: DensityState) -> StationaryPoint:
    return StationaryPoint(
        beta=beta,
        kappa=state.kappa,
        log_d=state.log_d,
        converged=torch.zeros(1, dtype=torch.bool),
        log_bound=state.log_bound,
        log_d_min=state.log_d_min,
        free_kappa=state.free_kappa,
        free_d=state.free_d,
    )


def _slopes(rows: Rows, rest: StationaryPoint) -> PassDerivatives:
    total, found = rows.look(rest.beta[0], Density(rest.kappa[0], torch.exp(rest.log_d[0])), bend=True)
    assert found is not None
    everything = total.weight.sum()
    grams = torch.stack([_gram(rows, rest, channel) for channel in range(rows.Y.shape[-1])])
    return PassDerivatives(found.curvature / everything, found.tilt / everything, grams / everything)


def _gram(rows: Rows, rest: StationaryPoint, channel: int) -> Float64[Tensor, "n n"]:
    """Sum of ``x xᵀ`` of a channel: the curvature of a Gaussian with d = 1."""
    part = slice(channel, channel + 1)
    weight = None if rows.weight is None else rows.weight[:, part]
    own = Rows(rows.X[:, part], rows.Y[:, part], weight, rows.frame)
    kappa = torch.zeros_like(rest.kappa[0, part])
    _, found = own.look(rest.beta[0], Density(kappa, torch.ones_like(kappa)), bend=True)
    assert found is not None
    return found.curvature


def _gaussian_is_likelier(rows: Rows, rest: StationaryPoint, end: DescentEnd, grams: Float64[Tensor, "m n n"]) -> bool:
    """Whether a Gaussian at least squares is likelier than the maximum found, of several channels whether it may be."""
    if not (rest.free_kappa and rest.free_d) or not bool((end.place.point.kappa > 0).any()):
        return False
    value = float(end.place.per_sample)
    if _gaussian_value(rest, end, grams * end.sums.weight.sum(), _SLACK) >= value:
        return False
    if grams.shape[0] > 1:
        return True
    return _gaussian_value(rest, end, _gram(rows, rest, 0).unsqueeze(0), 1.0) < value


def _gaussian_value(rest: StationaryPoint, end: DescentEnd, grams: Float64[Tensor, "m n n"], slack: float) -> float:
    """Mean negative log-likelihood of a Gaussian at the least squares of each channel.

    Least squares lowers a channel's sum of squares by ``gᵀ G⁻¹ g``, g being the sum of ``e x`` and G that of ``x xᵀ``.
    """
    assert rest.log_bound is not None
    assert rest.log_d_min is not None
    root = grams.diagonal(dim1=-2, dim2=-1).clamp(min=torch.finfo(grams.dtype).tiny).rsqrt()
    inverse = torch.linalg.pinv(root.unsqueeze(-1) * grams * root.unsqueeze(-2), hermitian=True)
    assert end.bends is not None
    moment = (end.bends.moment * root).unsqueeze(-1)
    lowered = torch.matmul(moment.mT, torch.matmul(inverse, moment)).flatten()
    variance = ((end.bends.square - slack * lowered) / end.sums.weight).clamp(min=0.0)
    d = torch.maximum(variance.sqrt(), torch.exp(rest.log_d_min[0]))
    norm = log_partition_value(torch.zeros_like(d), torch.exp(rest.log_bound[0]) / d)
    return float((torch.log(d) + 0.5 * variance / d.square() + norm).sum())


def _told(
    rows: Rows, rest: StationaryPoint, end: DescentEnd, found: CurvatureSums, weights: Float[Tensor, "N m"]
) -> LargeMaximum:
    point = end.place.point
    used = rows.Y.numel() if rows.weight is None else int((rows.weight > 0).sum())
    left = used - point.beta.shape[-1]
    coef, covariance = point.beta[0], _sandwich(found, used, left)
    if rows.frame is not None:
        coef, covariance = rows.frame @ coef, rows.frame @ covariance @ rows.frame.mT
    return LargeMaximum(
        coef=coef,
        rest=replace(rest, beta=coef.unsqueeze(0), kappa=point.kappa, log_d=point.log_d),
        weights=weights,
        log_likelihood=-(end.sums.weight * end.place.by_channel.value).sum(),
        covariance=covariance,
        dof=coef.new_tensor(float(left)),
        history=torch.stack(end.history),
    )


def _sandwich(found: CurvatureSums, used: int, left: int) -> Float64[Tensor, "n n"]:
    root = found.curvature.diagonal().rsqrt()
    outer = root.unsqueeze(-1) * root
    inverse = outer * torch.linalg.pinv(outer * found.curvature, hermitian=True)
    return used / max(left, 1) * inverse @ found.spread @ inverse
