"""Effects that are chosen with the simulation's parameters held at the values that the user gave."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import torch

from mkc_torch.diagnosis.model.fit import SEARCH, FittedModel, fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import shape_fitted
from mkc_torch.diagnosis.model.term import Term, run_parallel
from mkc_torch.diagnosis.search.along_noise import Models
from mkc_torch.diagnosis.search.move_fits import fitted_with
from mkc_torch.diagnosis.search.moves import additions, one_form_each
from mkc_torch.nonlinear import NoFitError

_TRIED = 3
"""Effects that are fitted at each step, of which the most likely is kept."""

_MOST = 3
"""Largest number of effects that are chosen in this way."""


def add_at_given_values(beam: Models, start: FittedModel, terms: Sequence[Term]) -> None:
    """Add models of two effects and more to a beam, if a parameter is far from the value that the user gave.

    Fitted parameters can take the place of several effects: a servo that is far too soft follows late and sags, where
    the true servo has play and a wrong zero. Then no single effect is a gain. The effects are chosen with the
    parameters held; each model is then fitted with all parameters free.

    Args:
        beam: receives the models.
        start: the simulation alone.
        terms: the candidates, with the shapes of their grids.
    """
    most = min(beam.most_terms, _MOST)
    held = _held(start, beam.settings.search.ran_away) if most > 1 else None
    named = [term for term in terms if not term.effect.is_curve]
    while held is not None and len(held.model.terms) < most:
        before, value = held, _worth(held, beam)
        found = one_form_each(additions(held, named, beam.settings.noise), beam.worth)
        found = [one for one in sorted(found, key=beam.worth, reverse=True)[:_TRIED] if beam.worth(one) > 0.0]
        tried = run_parallel([partial(fitted_with, held, one) for one in found], start.model.prepared, beam.terms)
        held = max(tried, key=partial(_worth, beam=beam), default=held)
        if not _worth(held, beam) > value:
            return
        if before.model.terms:
            model = beam.scored("choose effects at the given values", partial(_released, held, start))
            beam.keep([] if model is None else [replace(model, together=True)])


def _worth(fit: FittedModel, beam: Models) -> float:
    """Return the log-likelihood of a fit less the price of its effects."""
    pairs = zip(fit.model.terms, fit.model.gammas(fit.parameters), strict=True)
    return fit.log_likelihood - sum(beam.price_of(term, size) for term, size in pairs)


def _released(held: FittedModel, start: FittedModel) -> FittedModel | None:
    """Return the fit with all parameters free."""
    found = _fitted(JointModel(start.model.prepared, held.model.terms), held)
    return None if found is None else shape_fitted(found, SEARCH)


def _held(fit: FittedModel, away: float) -> FittedModel | None:
    """Return the fit with its parameters held, if one with a prior is far from its value; else None."""
    system = fit.model.prepared.dynamics
    if system is None:
        return None
    pairs = zip(system.known.values(), fit.parameters.tolist(), strict=False)
    far = any(
        known.uncertainty is not None and known.value > 0.0 and not known.value / away <= value <= known.value * away
        for known, value in pairs
    )
    if not far:
        return None
    own, (low, high) = system.given[: len(system.known)], system.bounds
    held = copy.copy(system)
    held.bounds = torch.cat([own, low[len(own) :]]), torch.cat([own, high[len(own) :]])
    return _fitted(JointModel(held), fit, torch.cat([own, fit.parameters[len(own) :]]))


def _fitted(model: JointModel, like: FittedModel, start: torch.Tensor | None = None) -> FittedModel | None:
    try:
        return fitted(model, like.parameters if start is None else start, effort=SEARCH, squares=like.sigma_held)
    except NoFitError:
        return None
