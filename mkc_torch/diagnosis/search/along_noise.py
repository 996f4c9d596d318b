"""Effects that are added along the process noise of a model, where an open loop is too sensitive for them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Protocol

from torch import Tensor

from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.process_noise import estimate_noise, has_only_drift, has_process_noise, under_noise
from mkc_torch.diagnosis.model.shapes import with_form_of_grid
from mkc_torch.diagnosis.model.term import Term, run_parallel
from mkc_torch.diagnosis.search.candidate import Candidate, ModelKey, model_key
from mkc_torch.diagnosis.search.moves import Addition, additions, one_form_each
from mkc_torch.diagnosis.settings import NoiseSettings, Settings
from mkc_torch.diagnosis.thresholds import PAYS
from mkc_torch.simulation.dynamics.noise import most_likely_noise
from mkc_torch.simulation.dynamics.noise_model import NoiseModel
from mkc_torch.simulation.dynamics.noise_selection import SelectedNoise

TRIED = 3
"""Number of effects that are tried in addition to a model."""


class Models(Protocol):
    """The part of a beam search that is used here; see :class:`mkc_torch.diagnosis.search.beam.BeamSearch`."""

    terms: tuple[Term, ...]
    settings: Settings
    declared: Mapping[str, float]
    models: dict[ModelKey, Candidate]
    most_terms: int
    most_models: int

    @property
    def best(self) -> Candidate: ...
    def worth(self, addition: Addition) -> float: ...
    def price_of(self, term: Term, size: Tensor) -> float: ...
    def id_of(self, term: Term) -> str: ...
    def distinct(self, fit: FittedModel, addition: Addition) -> FittedModel | None: ...
    def is_better(self, other: FittedModel, fit: FittedModel) -> bool: ...
    def value_of(self, fit: FittedModel) -> float: ...
    def scored(self, move: str, work: Callable[[], FittedModel | None]) -> Candidate | None: ...
    def keep(self, models: Iterable[Candidate]) -> None: ...


def add_along_noise(beam: Models, terms: Sequence[Term]) -> None:
    """Add effects to the best model of a beam along its process noise, as long as that raises the score.

    A trajectory that an observer corrects stays near the recording, so that the linear gain of an effect holds where
    a small force decides which way an open loop takes. A search for a single effect, whose candidates start along the
    noise of the simulation alone, does without.

    Args:
        beam: the models so far; receives the new ones, up to its largest number.
        terms: the candidates.
    """
    best = None
    if beam.most_terms == 1:
        return
    while best is not beam.best and len(beam.models) < beam.most_models:
        best = beam.best
        known = best.fit.model.terms
        if len(known) == beam.most_terms or any(term.effect.is_curve for term in known):
            return
        fit = _along_noise(best, beam)
        if fit is None:
            return
        found = one_form_each(additions(fit, terms, beam.settings.noise), beam.worth)
        pays = [one for one in found if one.gain >= PAYS * beam.price_of(*one.starts[0])]
        works = [
            partial(beam.scored, f"add {beam.id_of(one.starts[0][0])} along the noise", partial(_with, beam, fit, one))
            for one in sorted(pays, key=beam.worth, reverse=True)[: min(TRIED, beam.most_models - len(beam.models))]
        ]
        new = run_parallel(works, fit.model.prepared, beam.terms, "model")
        beam.keep([model for model in new if model is not None and model.value > _known(model, beam)])


def _along_noise(model: Candidate, beam: Models) -> FittedModel | None:
    """Return a model's fit along its process noise; None where its noise has none of a state."""
    fit = model.fit
    if has_process_noise(fit):
        return None if has_only_drift(fit) else fit
    if fit.model.open_loop_only or model.score is None:
        return None
    return fitted_along(fit, model.score.noise, beam.declared, beam.settings.noise)


def _with(beam: Models, fit: FittedModel, addition: Addition) -> FittedModel | None:
    """Return the fit with one more effect that scores higher: under the noise that is left with it, or in open loop.

    Each effect is at its best form.
    """
    found = beam.distinct(fit, addition)
    if found is None:
        return None
    found = under_its_noise(found, beam.declared, beam.settings.noise)
    for number in range(len(found.model.terms)):
        found = with_form_of_grid(found, criteria=(beam.is_better,), number=number)
    free = found.open_loop
    return free if free is not None and beam.value_of(free) > beam.value_of(found) else found


def _known(model: Candidate, beam: Models) -> float:
    """Return the score of the known model with the same effects."""
    known = beam.models.get(model_key(model.fit.model.terms))
    return -float("inf") if known is None else known.value


def fitted_along(
    fit: FittedModel, noise: NoiseModel, declared: Mapping[str, float], settings: NoiseSettings
) -> FittedModel | None:
    """Return a fit under the process noise of a noise model, whose sizes are fitted again; None where that fails.

    Args:
        fit: in open loop.
        noise: only its disturbances of rates are used.
        declared: known standard deviations of the outputs' white noise.
        settings: of the noise.
    """
    system = fit.model.prepared.dynamics
    assert system is not None
    each = noise.disturbances(system.disturbable, system.channels)
    acting = tuple(disturbance for disturbance in each if disturbance.at_rate)
    if not acting:
        return None
    unknown, sensor = (math.inf,) * len(acting), fit.residual.new_tensor(noise.sensor)
    known = tuple(name in declared for name in system.channels)
    given = SelectedNoise(acting, unknown, unknown, sensor, -math.inf, known)
    theta, changes = fit.parameters[: fit.model.base], fit.model.changes(fit.parameters)
    least, most = settings.disturbance_gain, settings.max_disturbances
    sized = most_likely_noise(
        system, theta, changes, fit.model.near, declared=declared, least=least, most=most, known=given
    )
    found = under_noise(fit, sized, declared, settings)
    return None if found is None or not has_process_noise(found[0]) else found[0]


def under_its_noise(fit: FittedModel, declared: Mapping[str, float], settings: NoiseSettings) -> FittedModel:
    """Return a fit along an observer, fitted again under the noise that is most likely along it; else the same fit."""
    found = under_noise(fit, estimate_noise(fit, declared, settings), declared, settings)
    return fit if found is None else found[0]
