"""Fit and score the sets of effects that the user suspects, next to what the search finds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from mkc_torch.diagnosis.decisions import ScoredModel
from mkc_torch.diagnosis.findings.finding import all_parameters
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.process_noise import refit_open_loop
from mkc_torch.diagnosis.model.suspect import suspect_id, suspected_terms
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.optional import optional
from mkc_torch.diagnosis.parts import EffectParameter
from mkc_torch.diagnosis.pipeline.trail import scored_model
from mkc_torch.diagnosis.search.beam import BeamSearch
from mkc_torch.diagnosis.search.candidate import Candidate
from mkc_torch.diagnosis.search.estimate import estimate, rough_estimate
from mkc_torch.diagnosis.settings import NoiseSettings
from mkc_torch.nonlinear import NoFitError

SUSPECTED = "suspected"
"""Move of a suspected model in the trail."""


def suspected_models(
    texts: Sequence[str], beam: BeamSearch, start: FittedModel, noise: NoiseSettings, *, quick: bool
) -> tuple[ScoredModel, ...]:
    """Return the suspected sets of effects with their scores; the models of the search stay as they are.

    Args:
        texts: the suspected sets, checked by :func:`mkc_torch.diagnosis.model.suspect.refuse_unknown`.
        beam: the search, which gives candidates and the basis of all scores.
        start: the simulation alone.
        noise: settings.
        quick: True for a single order of the effects, without standard errors.
    """
    found = []
    for text in texts:
        groups = suspected_terms(text, beam.terms, start.model.prepared)
        names = tuple(suspect_id(group[0], beam.terms) for group in groups)

        def scored(groups: Sequence[Sequence[Term]] = groups) -> ScoredModel:
            model = beam.fitted_set(groups, start, SUSPECTED, thorough=not quick)
            known = replace(scored_model(model, beam), suspected=True)
            return known if model.score is None else replace(known, parameters=_parameters(model, noise, quick=quick))

        def unscored(names: tuple[str, ...] = names) -> ScoredModel:
            return ScoredModel(names, SUSPECTED, None, {}, "", {}, suspected=True)

        found.append(optional(f"scoring the suspected {' + '.join(names)}", scored, unscored))
    return tuple(found)


def _parameters(model: Candidate, noise: NoiseSettings, *, quick: bool) -> tuple[tuple[EffectParameter, ...], ...]:
    """Return the parameters of each effect in open loop, or under the noise of the fit if that loses the recording."""
    free = refit_open_loop(model.fit)
    fit = model.fit if free is None else free
    unknown = rough_estimate(fit, torch.full_like(fit.parameters, torch.nan))
    try:
        final = unknown if quick else estimate(fit, noise)
    except NoFitError:
        final = unknown
    return tuple(all_parameters(final, number) for number in range(len(fit.model.terms)))
