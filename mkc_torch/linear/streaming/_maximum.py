"""The maximum of the likelihood of streamed rows, from the fit of their sample."""

from __future__ import annotations

from dataclasses import replace

import torch

from mkc_torch.linear._blocks import PassResult
from mkc_torch.linear._descent import Descent
from mkc_torch.linear._implicit.stationary import FitState
from mkc_torch.linear._many_rows import RowsMaximum, maximum_of, more_likely_gaussian, run_descent
from mkc_torch.linear.streaming._rows import StreamedRows

_NEAR = 2e-5
"""Distance from the maximum, in standard errors of one row, below which a pass computes the curvature.

The covariance is then as accurate as this, and a step with the curvature leaves the square of the distance."""

_FURTHEST = 0.03
"""The same in standard errors, for many rows."""

_LONGER = 0.5
"""Log of the ratio of the domain to the sample's up to which the sums at the sample's density are a step's.

On a longer domain the share of its tail is adapted first."""

_SLOW = 0.1
"""Share of the length of a step that the next may have; beyond it, the curvature is computed again."""

_EXACT_PASSES = 8
"""Passes after which a fit through most values to rounding, whose precision is limited, ends."""


def streamed_maximum(source: StreamedRows, *, learns_domain: bool, max_passes: int) -> tuple[RowsMaximum, bool]:
    """Maximise the likelihood in at most ``max_passes`` passes; return the maximum and whether it was reached.

    ``learns_domain``: the domain is to cover the residuals of all rows.
    """
    pilot, survey = source.pilot, source.survey
    near = min(_NEAR * float(survey.weight.sum()) ** 0.5, _FURTHEST)
    options = {"near": near, "stop": 2.0 * near, "fresh": True, "slow": _SLOW}

    def descend(descent: Descent, first: PassResult | None = None) -> Descent:
        # the last pass is for the covariance in any case
        most = max_passes - 1 - source.passes + (first is not None)
        return run_descent(source, descent, min(most, _EXACT_PASSES) if pilot.exact else most, first)

    descent = source.begin(pilot.fit_state, **options)
    first: PassResult | None = None
    # with a sample of all rows the range is known
    if learns_domain and pilot.rows < survey.rows:
        found = source.evaluate(descent, with_range=True)
        start = source.ranks.from_first(lambda: _on_domain(descent, found))
        if torch.equal(start.kappa, descent.fit_state.kappa):
            descent, first = replace(descent, fit_state=start), found
        else:
            descent = source.begin(start, **options)
    end = descend(descent, first)
    if end.done and source.passes < max_passes - 1:
        gaussian = source.ranks.from_first(lambda: more_likely_gaussian(end, pilot.slopes.grams))
        if gaussian is not None:
            end = descend(replace(source.begin(gaussian, slopes_valid=False, **options), history=end.history))
    if not end.done:
        assert end.best is not None
        last = replace(end, point=end.best.point, left=0.0)
        end = source.after(last, source.evaluate(last))
    converged = end.done or pilot.exact
    return source.ranks.from_first(
        lambda: (maximum_of(end, survey.used, survey.frame(), with_last_step=end.done), converged)
    )


def _on_domain(descent: Descent, result: PassResult) -> FitState:
    """Start on the domain: half the range of all residuals, and at least the sample's, which includes ten of its d."""
    start = descent.fit_state
    assert result.extent is not None
    assert start.log_bound is not None
    log_bound = torch.maximum(start.log_bound, torch.log(result.extent.half()))
    longer = log_bound - start.log_bound
    start = replace(start, log_bound=log_bound)
    if not start.free_kappa or bool((longer <= _LONGER).all()):
        return start
    # keep the tail density exp(-1/κ) / bound unchanged on the longer domain
    inverse = torch.where(start.kappa > 0, start.kappa, 1.0).reciprocal() + longer
    return replace(start, kappa=torch.where(start.kappa > 0, inverse.reciprocal(), 0.0))
