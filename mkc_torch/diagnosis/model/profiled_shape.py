"""Delays and lags of inputs by a profile of the likelihood: gradients alone end at a nearby local maximum."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.shapes import reach_of, shape_fitted
from mkc_torch.diagnosis.model.term import Term, run_parallel
from mkc_torch.nonlinear import NoFitError

_FACTORS = (0.5, 0.71, 0.84, 0.92, 1.09, 1.19, 1.41, 2.0)
"""Factors by which a delay or a lag is varied in each round."""

_LEADING = 2
"""Number of the most likely variants whose shape is fitted in each round."""

_ROUNDS = 4
"""Largest number of rounds."""

_SETTLED_NATS = 0.5
"""Gain of a round up to which there is no further round."""


def with_profiled_shape(fit: FittedModel) -> FittedModel:
    """Return the fit with the delay or lag of its last effect, on an input, at the maximum of the profile likelihood.

    A delay of an input that is held between samples changes the trajectory in steps: the likelihood has a local maximum
    near each multiple of the sample interval, at which a fit of all parameters together stops. So all other parameters
    are refitted at several delays. Effects at other ports are returned unchanged.

    Args:
        fit: with at least one effect, at its most likely parameters.
    """
    for _ in range(_ROUNDS):
        others = list(_varied(fit))
        if not others:
            return fit
        known = fit.model.prepared, [fit.model.terms[-1]]
        tried = [found for found in run_parallel([partial(_with_last, fit, term) for term in others], *known) if found]
        leading = sorted(tried, key=lambda found: -found.log_likelihood)[:_LEADING]
        shaped = run_parallel([partial(shape_fitted, found) for found in leading], *known)
        best = max(shaped, key=lambda found: found.log_likelihood, default=fit)
        if not best.log_likelihood > fit.log_likelihood + _SETTLED_NATS:
            return fit
        fit = best
    return fit


def _varied(fit: FittedModel) -> Iterator[Term]:
    """Yield the last effect with each of its delays and lags varied, within the limits."""
    term, prepared = fit.model.terms[-1], fit.model.prepared
    if prepared.ports[term.port].kind != "input" or prepared.dynamics is None:
        return
    for name, (low, high) in reach_of(term, prepared).items():
        if name in term.effect.continuous:
            for value in sorted({min(max(factor * term.shape[name], low), high) for factor in _FACTORS}):
                yield replace(term, shape={**term.shape, name: value})


def _with_last(fit: FittedModel, term: Term) -> FittedModel | None:
    """Refit with another shape of the last effect; None if there is no finite trajectory."""
    try:
        return fitted(fit.model.with_last(term), fit.parameters, fit.bound, graduate=False)
    except NoFitError:
        return None
