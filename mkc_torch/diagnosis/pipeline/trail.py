"""The scored models of a search, for the trail."""

from __future__ import annotations

from collections.abc import Mapping

from mkc_torch.diagnosis.decisions import ScoredModel
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.process_noise import refit_open_loop
from mkc_torch.diagnosis.model.suspect import suspect_id
from mkc_torch.diagnosis.score import Score
from mkc_torch.diagnosis.search.beam import BeamSearch
from mkc_torch.diagnosis.search.candidate import Candidate, model_key


def trail_of(beam: BeamSearch, chosen: FittedModel | None) -> tuple[ScoredModel, ...]:
    """Return the scored models in the order in which they were tried.

    Args:
        beam: the search.
        chosen: the fit with all findings; None without findings.
    """
    key = None if chosen is None else model_key(chosen.model.terms)
    return tuple(scored_model(model, beam, chosen=model.key == key) for model in beam.models.values())


def scored_model(model: Candidate, beam: BeamSearch, *, chosen: bool = False) -> ScoredModel:
    """Return a model with its score, its noise and its open-loop residual."""
    score, fit = model.score, model.fit
    terms = tuple(suspect_id(term, beam.terms) for term in fit.model.terms)
    if score is None:
        return ScoredModel(terms, model.move, None, {}, "", _open_loop(fit), chosen)
    parts = {
        "log_likelihood": score.log_likelihood,
        "numbers": score.numbers,
        "terms": score.terms,
        "disturbances": score.disturbances,
        "forms": score.forms,
        "given": score.given,
    }
    return ScoredModel(terms, model.move, score.value, parts, _noise(score, fit), _open_loop(fit), chosen)


def _noise(score: Score, fit: FittedModel) -> str:
    """Return the kind of noise in words."""
    system = fit.model.prepared.dynamics
    assert system is not None
    names = [
        f"{'process noise of' if disturbance.at_rate else 'drift of'} {disturbance.place}"
        for disturbance in score.noise.disturbances(system.disturbable, system.channels)
    ]
    return ", ".join(names) or "white"


def _open_loop(fit: FittedModel) -> Mapping[str, float]:
    """Return the RMS of the open-loop residual of each output; empty if the open loop loses the recording."""
    free = refit_open_loop(fit)
    if free is None:
        return {}
    return dict(zip(fit.model.prepared.channels, free.residual.square().mean(0).sqrt().tolist(), strict=True))
