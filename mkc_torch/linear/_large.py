"""MKC-EM on many rows in memory or on a GPU: a pilot fit to few rows, and Newton steps on all.

The steps start at the result of the pilot, with the curvature of a few more rows, so that few passes over all rows are
needed; four or five are usual. They end where a step with the curvature of all rows would be shorter than a millionth
of a standard error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.density.domain import WIDE
from mkc_torch.density.likelihood import DensityState
from mkc_torch.linear._basis import nearly_dependent
from mkc_torch.linear._blocks import Density, PassResult
from mkc_torch.linear._descent import Descent, PassDerivatives
from mkc_torch.linear._implicit.stationary import FitState
from mkc_torch.linear._many_rows import RowsMaximum, maximum_of, more_likely_gaussian, run_descent
from mkc_torch.linear._maximum import TIGHT, FixedParameters, lower_limit_of_d, rough_fit
from mkc_torch.linear._pilot import drawn_rows, pilot_problem, rows_at, rows_of
from mkc_torch.linear._problem import MAX_IMPLIED_CHANNELS, CanonicalShapes, LinearProblem
from mkc_torch.linear._robust_start import RobustStart, robust_start
from mkc_torch.linear._rows import Rows

if TYPE_CHECKING:
    from jaxtyping import Float, Float64

LARGE = 20_000
"""Number of values from which a fit starts with a pilot; with nine columns it is four times as fast there."""

_NEAR = 0.03
"""Distance from the maximum, in standard errors, below which the curvature of all rows is computed."""

_STOP = 1e-6
"""Length of the next step, in standard errors, below which the fit has converged."""

_PASSES = 15
"""Largest number of passes; a fit that has not converged then is left to the alternation over all rows."""

_WIDEST = 2.0
"""Largest d of a rough fit, in robust scales of the start; a larger d is that of a Gaussian over the outliers."""

_TAILS = (0.1, 0.2, 0.4, 1.5)
"""Starting values of κ of the rough fit: one more than usual, since evaluating it costs less than an alternation."""

_FOR_SLOPES = 8
"""Rows for the first curvature, in multiples of the pilot's rows: each step then leaves a twentieth of the distance."""

_SLACK = 2.0
"""Factor on the bound of the gain of least squares, since the pilot's products only approximate those of all."""


def is_large(values: CanonicalShapes) -> bool:
    """Whether :func:`large_maximum` suits these values: one problem of many rows, on a CPU or a GPU with float64."""
    return (
        values.Y.numel() >= LARGE
        and values.batch.numel() == 1
        and values.Y.shape[-1] <= MAX_IMPLIED_CHANNELS
        and values.Y.device.type in ("cpu", "cuda")
        and not torch.compiler.is_compiling()
    )


def problem_in_basis(problem: LinearProblem) -> CanonicalShapes:
    """Return a problem whose X is the basis of ``problem``."""
    basis = problem.basis.expand(problem.Y.shape[0], -1, -1, -1)
    weight = None if problem.sample_weight is None else problem.restore(problem.sample_weight)
    return CanonicalShapes(
        problem.restore(basis), problem.restore(problem.Y), weight, problem.batch, problem.single_channel
    )


@dataclass(frozen=True)
class _InMemory:
    """Rows as a source of passes; a pass that may be the last fills ``weights``."""

    rows: Rows
    weights: Float[Tensor, "N m"]

    def evaluate(self, descent: Descent, *, with_range: bool = False) -> PassResult:
        return self.rows.evaluate(
            descent.point.beta[0],
            descent.density(),
            with_curvature=descent.with_curvature,
            with_range=with_range,
            weights=self.weights if descent.close else None,
        )

    def after(self, descent: Descent, result: PassResult) -> Descent:
        return descent.after(result)


def large_maximum(
    values: CanonicalShapes, known: FixedParameters, *, max_iter: int, seed: int
) -> tuple[RowsMaximum, Float[Tensor, "N m"]] | None:
    """Maximise the likelihood of one problem of many rows; return the maximum and the weights of the values.

    Returns None if values are not finite, no pilot represents all rows, the rough fit finds no head, most values are
    fitted exactly, d ends at its lower limit, a Gaussian has a higher likelihood than the result, or the passes do not
    converge. An alternation over all rows then reports the error or finds the maximum.
    """
    rows, passes = rows_of(values), min(max_iter, _PASSES)
    pilot = _pilot(values, known, max_iter, seed) if _is_valid(rows) else None
    if pilot is None:
        return None
    rows, fit_state = replace(rows, frame=pilot.frame), pilot.fit_state
    source = _InMemory(rows, torch.empty_like(rows.Y))
    # rows drawn by leverage do not represent the curvature of all rows, and another draw may lack rare rows
    count = pilot.problem.num_samples
    slopes = _slopes(
        _drawn_rows(values, _FOR_SLOPES * count, pilot.frame, seed) if pilot.representative else rows, fit_state
    )
    first: PassResult | None = None
    if known.bound is None:
        descent = Descent.begin(fit_state, slopes, near=0.0, stop=1.0)
        # the sums do not depend on the domain, so this is also the first pass of the descent
        begin = source.evaluate(descent, with_range=True)
        half = torch.maximum(_half_range(begin), TIGHT * pilot.begin.scale)
        fit_state = replace(fit_state, log_bound=torch.log(half))
        if pilot.representative:
            end = run_descent(source, replace(descent, fit_state=fit_state), passes, begin, with_range=True)
            if end.done and end.best is not None:
                point, begin = end.point, end.best.result
                fit_state = replace(fit_state, beta=point.beta, kappa=point.kappa, log_d=point.log_d)
        fit_state, same = _start_on_final_domain(pilot, known, fit_state, begin)
        first = begin if same else None
    descent = Descent.begin(fit_state, slopes, near=_NEAR, stop=_STOP, slopes_valid=pilot.representative)
    end = run_descent(source, descent, passes, first)
    if not end.done or _d_is_at_its_lower_limit(end) or _gaussian_is_more_likely(rows, end):
        return None
    used = rows.Y.numel() if rows.weight is None else int((rows.weight > 0).sum())
    return maximum_of(end, used, rows.frame, with_last_step=False), source.weights


@dataclass(frozen=True)
class _Pilot:
    """A rough fit to few rows, in the frame of :class:`Rows`; ``representative``: all rows had the same probability."""

    problem: LinearProblem
    representative: bool
    begin: RobustStart
    frame: Float64[Tensor, "n n"] | None
    fit_state: FitState

    def in_basis(self, beta: Float64[Tensor, "1 n"]) -> Float64[Tensor, "1 n"]:
        """Return coefficients in the basis of the pilot's problem."""
        return beta if self.frame is not None else torch.linalg.solve(self.problem.to_coef[0], beta.mT).mT


def _pilot(values: CanonicalShapes, known: FixedParameters, max_iter: int, seed: int) -> _Pilot | None:
    drawn = pilot_problem(values, seed)
    if drawn is None:
        return None
    problem, representative = drawn
    begin = robust_start(problem, known.start, seed=seed, pilot=True)
    if bool(begin.exact.any()):
        return None
    rough = rough_fit(problem, known, begin, max_iter=max_iter, tails=_TAILS)
    learned = known.sigma is None and known.d is None
    if learned and bool((torch.exp(rough.state.log_d) > _WIDEST * begin.scale).any()):
        return None
    frame = _frame(problem)
    beta = rough.beta if frame is not None else torch.matmul(rough.beta, problem.to_coef[0].mT)
    return _Pilot(problem, representative, begin, frame, _state_at(beta, rough.state))


def _start_on_final_domain(
    pilot: _Pilot, known: FixedParameters, rough: FitState, found: PassResult
) -> tuple[FitState, bool]:
    """Starting point on the domain of the rule, from the pass at the rough fit; whether it equals the rough fit."""
    d = torch.exp(rough.log_d)
    bound = torch.maximum(_half_range(found), WIDE * d)
    beta = pilot.in_basis(rough.beta)
    least = lower_limit_of_d(pilot.problem, pilot.begin)
    state = known.initial_state(pilot.problem, beta, d, bound, least, tails=(rough.kappa,))
    if torch.allclose(state.kappa, rough.kappa) and torch.allclose(state.log_d, rough.log_d):
        return replace(rough, log_bound=state.log_bound), True
    return _state_at(rough.beta, state), False


def _half_range(found: PassResult) -> Float64[Tensor, " m"]:
    assert found.extent is not None
    return found.extent.half()


def _drawn_rows(values: CanonicalShapes, count: int, frame: Float64[Tensor, "n n"] | None, seed: int) -> Rows:
    return replace(rows_of(rows_at(values, drawn_rows(values, count, seed + count))), frame=frame)


def _is_valid(rows: Rows) -> bool:
    """Whether all values are finite, weights valid, and fourth powers of Y neither overflow nor underflow."""
    numbers = [*torch.aminmax(rows.Y), *torch.aminmax(rows.X)]
    if rows.weight is not None:
        numbers += [*torch.aminmax(rows.weight), rows.weight.sum(0).amin()]
    # one copy from the device
    low, high, *others = torch.stack(numbers).tolist()
    limit = float(torch.finfo(rows.Y.dtype).max) ** 0.25
    if rows.weight is not None and not (others[2] >= 0.0 and others[4] > 0.0):
        return False
    return 1.0 / limit <= max(-low, high) <= limit and all(math.isfinite(value) for value in others)


def _d_is_at_its_lower_limit(end: Descent) -> bool:
    """Whether d ended at its lower limit, which the pilot determines."""
    return end.fit_state.free_d and bool((end.point.log_d <= end.fit_state.limits[0]).any())


def _frame(problem: LinearProblem) -> Float64[Tensor, "n n"] | None:
    """The pilot's basis where columns of X are nearly dependent, else None."""
    to_coef = problem.to_coef[0]
    return to_coef if nearly_dependent(torch.linalg.inv(to_coef)) else None


def _state_at(beta: Float64[Tensor, "1 n"], state: DensityState) -> FitState:
    return FitState.of(beta, state, torch.zeros(1, dtype=torch.bool))


def _slopes(rows: Rows, fit_state: FitState) -> PassDerivatives:
    density = Density(fit_state.kappa[0], torch.exp(fit_state.log_d[0]))
    result = rows.evaluate(fit_state.beta[0], density, with_curvature=True)
    return PassDerivatives.of(result, _grams(rows, fit_state) / result.total.weight.sum())


def _grams(rows: Rows, fit_state: FitState) -> Float64[Tensor, "m n n"]:
    """Sum of ``x xᵀ`` of each channel: the curvature of a Gaussian with d = 1."""
    found = []
    for channel in range(rows.Y.shape[-1]):
        part = slice(channel, channel + 1)
        weight = None if rows.weight is None else rows.weight[:, part]
        own = Rows(rows.X[:, part], rows.Y[:, part], weight, rows.frame)
        kappa = torch.zeros_like(fit_state.kappa[0, part])
        more = own.evaluate(fit_state.beta[0], Density(kappa, torch.ones_like(kappa)), with_curvature=True).curvature
        assert more is not None
        found.append(more.curvature)
    return torch.stack(found)


def _gaussian_is_more_likely(rows: Rows, end: Descent) -> bool:
    """Whether a Gaussian at least squares has a higher likelihood than the result."""
    if more_likely_gaussian(end, end.slopes.grams, _SLACK) is None:
        return False
    return more_likely_gaussian(end, _grams(rows, end.fit_state) / end.end[0].result.total.weight.sum()) is not None
