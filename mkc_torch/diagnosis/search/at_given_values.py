"""Effects that are chosen with the simulation's parameters held at the values that the user gave."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import torch

from mkc_torch.diagnosis.model.fit import SEARCH, FittedModel, fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import shape_fitted
from mkc_torch.diagnosis.model.term import Term, run_parallel
from mkc_torch.diagnosis.search.along_noise import Models as Searched
from mkc_torch.diagnosis.search.candidate import Candidate
from mkc_torch.diagnosis.search.move_fits import fitted_with
from mkc_torch.diagnosis.search.moves import additions, one_form_each
from mkc_torch.nonlinear import NoFitError
from mkc_torch.simulation.dynamics.unlikely import is_unlikely

_TRIED = 3
"""Effects that are fitted at each step, of which the most likely is kept; 1 in a search of few models."""

_MOST = 3
"""Largest number of effects that are chosen in this way."""


@dataclass(frozen=True)
class AtGivenValues:
    """A model in which effects take the place of numbers that a fit without effects takes far from the values given.

    Attributes:
        values: the values given, by parameter, at which these are held.
        model: the model.
    """

    values: Mapping[str, float]
    model: Candidate


class Models(Searched, Protocol):
    """The part of a beam search that is used here."""

    at_given: AtGivenValues | None


def add_at_given_values(beam: Models, start: FittedModel, terms: Sequence[Term]) -> AtGivenValues | None:
    """Add models of two effects and more to a beam, if a parameter is far from the value that the user gave.

    Fitted parameters can take the place of several effects: a servo that is far too soft follows late and sags, where
    the true servo has play and a wrong zero. Then no single effect is a gain. The effects are chosen with the unlikely
    parameters held; each model is then fitted with all parameters free.

    Args:
        beam: receives the models.
        start: the simulation alone.
        terms: the candidates, with the shapes of their grids.

    Returns:
        The last model with the parameters held, which only a measurement of these may distinguish from a model with
        other values; None if no parameter is unlikely or no effect takes its place.
    """
    values, held = _at_given(start)
    last = held
    while held is not None and len(held.model.terms) < _MOST:
        held = _with_one_more(held, beam, terms)
        last = last if held is None else held
        if held is not None and 1 < len(held.model.terms) <= beam.most_terms:
            model = beam.scored("choose effects at the given values", partial(_released, held, start))
            beam.keep([] if model is None else [replace(model, together=True)])
    model = beam.scored("hold unlikely numbers", lambda: last) if last is not None and last.model.terms else None
    return None if model is None or model.score is None else AtGivenValues(values, model)


def instead_of_numbers(beam: Models, final: FittedModel, terms: Sequence[Term]) -> AtGivenValues | None:
    """Return the model in which effects take the place of a model's unlikely numbers; None where it has none.

    A servo that is too soft follows late, and so does a servo with a delay: the recording may prefer the number, and
    only its measurement distinguishes the two. Effects are added to those of the model, of which physics may be part,
    or to none, because some may suit the unlikely numbers alone; the model that scores higher is returned.

    Args:
        beam: the search that found the model.
        final: the model.
        terms: the candidates, with the shapes of their grids.
    """
    values, held = _at_given(final if final.open_loop is None else final.open_loop)
    if held is None:
        return None
    last, known = held, len(held.model.terms)
    while (more := _with_one_more(last, beam, terms)) is not None and len(more.model.terms) <= known + _MOST:
        last = more
    model = beam.scored("hold unlikely numbers", lambda: last) if last is not held else None
    found = [] if model is None or model.score is None else [AtGivenValues(values, model)]
    if beam.at_given is not None and values.keys() <= beam.at_given.values.keys():
        found.append(beam.at_given)
    return max(found, key=lambda one: one.model.value, default=None)


def unlikely_values(fit: FittedModel) -> dict[str, float]:
    """Return the values given for the parameters that a fit takes far from these."""
    system = fit.model.prepared.dynamics
    if system is None:
        return {}
    pairs = zip(system.known.items(), fit.parameters.tolist(), strict=False)
    return {name: known.value for (name, known), value in pairs if is_unlikely(system, known, value)}


def _at_given(fit: FittedModel) -> tuple[dict[str, float], FittedModel | None]:
    """Return the values given for all unlikely numbers of a fit, and the fit with these held; None without any."""
    values: dict[str, float] = {}
    held: FittedModel | None = fit
    while held is not None and (far := {k: v for k, v in unlikely_values(held).items() if k not in values}):
        values |= far
        held = _held_at(held, values)
    return values, held if values else None


def _held_at(fit: FittedModel, values: Mapping[str, float]) -> FittedModel | None:
    """Return the fit with some parameters held at given values."""
    system = fit.model.prepared.dynamics
    assert system is not None
    start, (low, high) = fit.parameters.clone(), system.bounds
    low, high = low.clone(), high.clone()
    for number, name in enumerate(system.known):
        if name in values:
            start[number] = low[number] = high[number] = values[name]
    held = copy.copy(system)
    held.bounds = low, high
    return _fitted(JointModel(held, fit.model.terms, fit.model.near), fit, start)


def _with_one_more(held: FittedModel, beam: Models, terms: Sequence[Term]) -> FittedModel | None:
    """Return the fit with the further effect that is worth most, of a number; None where none is worth its price."""
    named = [term for term in terms if not term.effect.is_curve]
    tried = _TRIED if beam.most_models > 10 * _TRIED else 1
    found = one_form_each(additions(held, named, beam.settings.noise), beam.worth)
    found = [one for one in sorted(found, key=beam.worth, reverse=True)[:tried] if beam.worth(one) > 0.0]
    fits = run_parallel([partial(fitted_with, held, one) for one in found], held.model.prepared, beam.terms)
    best = max(fits, key=partial(_worth, beam=beam), default=held)
    return best if _worth(best, beam) > _worth(held, beam) else None


def _worth(fit: FittedModel, beam: Models) -> float:
    """Return the log-likelihood of a fit less the price of its effects."""
    pairs = zip(fit.model.terms, fit.model.gammas(fit.parameters), strict=True)
    return fit.log_likelihood - sum(beam.price_of(term, size) for term, size in pairs)


def _released(held: FittedModel, start: FittedModel) -> FittedModel | None:
    """Return the fit with all parameters free."""
    found = _fitted(JointModel(start.model.prepared, held.model.terms), held)
    return None if found is None else shape_fitted(found, SEARCH)


def _fitted(model: JointModel, like: FittedModel, start: torch.Tensor | None = None) -> FittedModel | None:
    try:
        return fitted(model, like.parameters if start is None else start, effort=SEARCH, squares=like.sigma_held)
    except NoFitError:
        return None
