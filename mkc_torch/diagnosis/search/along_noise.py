"""Effects that are added along the process noise of a model, where an open loop is too sensitive for them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.process_noise import along_noise, has_only_drift, has_process_noise, under_its_noise
from mkc_torch.diagnosis.model.shapes import with_form_of_grid
from mkc_torch.diagnosis.model.term import Term, run_parallel
from mkc_torch.diagnosis.search.candidate import Candidate, ModelKey, model_key
from mkc_torch.diagnosis.search.moves import Addition, additions, one_form_each
from mkc_torch.diagnosis.thresholds import PAYS

if TYPE_CHECKING:
    from mkc_torch.diagnosis.search.beam import BeamSearch

TRIED = 3
"""Number of effects that are tried in addition to a model."""

_LEADING = 3
"""Number of leading models to which effects are added."""


def add_along_noise(beam: BeamSearch, terms: Sequence[Term]) -> None:
    """Add effects along the process noise to the best models of a beam that the recording cannot separate.

    A trajectory that an observer corrects stays near the recording, so that the linear gain of an effect holds where
    a small force decides which way an open loop takes.

    Args:
        beam: the models so far; receives the new ones, up to its largest number.
        terms: the candidates.
    """
    done: set[ModelKey] = set()
    while len(beam.models) < beam.most_models:
        waiting = [model for model in _leading(beam) if model.key not in done]
        if not waiting:
            return
        done.add(waiting[0].key)
        _add_to(waiting[0], beam, terms)


def _leading(beam: BeamSearch) -> list[Candidate]:
    """Return the best models that may have one more effect, best first."""
    best = beam.best
    least = best.value - beam.settings.naming.separable * beam.basis.kappa
    near = sorted((model for model in beam.models.values() if model.value >= least), key=lambda model: -model.value)
    near = [best, *(model for model in near if model is not best and not beam.enlarges(model))][:_LEADING]
    return [
        model
        for model in near
        if len(model.fit.model.terms) < beam.most_terms and not any(t.effect.is_curve for t in model.fit.model.terms)
    ]


def _add_to(model: Candidate, beam: BeamSearch, terms: Sequence[Term]) -> None:
    """Add effects to a model along its process noise; nothing if its noise has none of a state."""
    fit = _along_noise(model, beam)
    if fit is None:
        return
    found = sorted(one_form_each(additions(fit, terms, beam.settings.noise), beam.worth), key=beam.worth, reverse=True)
    pays = [one for one in found if one.gain >= PAYS * beam.price_of(*one.starts[0])]
    works = [
        partial(beam.scored, f"add {beam.id_of(one.starts[0][0])} along the noise", partial(_with, beam, fit, one))
        for one in pays[: min(TRIED, beam.most_models - len(beam.models))]
    ]
    new = run_parallel(works, fit.model.prepared, beam.terms, "model")
    beam.keep([model for model in new if model is not None and model.value > _known(model, beam)])


def _along_noise(model: Candidate, beam: BeamSearch) -> FittedModel | None:
    """Return a model's fit along its process noise; None where its noise has none of a state."""
    fit = model.fit
    if has_process_noise(fit):
        return None if has_only_drift(fit) else fit
    if fit.model.open_loop_only or model.score is None:
        return None
    return along_noise(fit, model.score.noise, beam.declared, beam.settings.noise)


def _with(beam: BeamSearch, fit: FittedModel, addition: Addition) -> FittedModel | None:
    """Return the fit with one more effect, under the noise that is left with it, at the best form of each effect."""
    found = beam.distinct(fit, addition)
    if found is None:
        return None
    found = under_its_noise(found, beam.declared, beam.settings.noise)
    for number in range(len(found.model.terms)):
        found = with_form_of_grid(found, value=beam.value_of, number=number)
    return found


def _known(model: Candidate, beam: BeamSearch) -> float:
    """Return the score of the known model with the same effects."""
    known = beam.models.get(model_key(model.fit.model.terms))
    return -float("inf") if known is None else known.value
