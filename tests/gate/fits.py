"""Fits of the known set and of the returned set of effects of a recording, on the same basis of scores."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from mkc_torch.cli.diagnosis_files import read_recording, simulation_of
from mkc_torch.cli.diagnosis_request import LEVEL, SURROGATES, Request
from mkc_torch.diagnosis.diagnose import MAX_FINDINGS
from mkc_torch.diagnosis.io.model import DiagnosedModel
from mkc_torch.diagnosis.model.fit import FittedModel, fitted, fitted_with_effect
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.process_noise import fit_with_process_noise
from mkc_torch.diagnosis.model.shapes import shape_fitted
from mkc_torch.diagnosis.model.suspect import suspected_terms
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.pipeline.partial import PartialResult
from mkc_torch.diagnosis.pipeline.prepare import SearchOptions, prepare
from mkc_torch.diagnosis.pipeline.search import fit_baseline
from mkc_torch.diagnosis.score import Score, ScoreBasis, basis_of, score
from mkc_torch.diagnosis.search.beam import BeamSearch
from mkc_torch.diagnosis.search.moves import additions
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.effects import CATALOGUE
from mkc_torch.nonlinear import NoFitError
from mkc_torch.simulation import Simulation
from tests.gate.known_sets import KnownSet


@dataclass(frozen=True)
class Case:
    """A recording with the fit of its simulation alone.

    Attributes:
        simulation: as the user gives it.
        alone: the fit without effects in open loop, or under process noise if the open loop is lost.
        noisy: the fit without effects under its noise.
        terms: the candidates.
        basis: of all scores of the recording.
        settings: thresholds.
    """

    simulation: Simulation
    alone: FittedModel
    noisy: FittedModel
    terms: tuple[Term, ...]
    basis: ScoreBasis
    settings: Settings


@dataclass(frozen=True)
class ScoredFit:
    """A fit with its score in nats; ``score`` is None if the fit loses the recording."""

    fit: FittedModel
    score: Score | None

    @property
    def value(self) -> float:
        return -float("inf") if self.score is None else self.score.value


def case_of(recording: Path, request: Request) -> Case:
    """Fit the simulation alone, as a diagnosis does before its search."""
    settings, simulation = Settings(), simulation_of(request)
    options = SearchOptions(
        LEVEL, SURROGATES, MAX_FINDINGS, request.seed, settings, dict(request.noise), dict(request.input_hold)
    )
    problem = prepare(simulation, read_recording(recording, request), CATALOGUE, options, None, lambda _: None)
    known = PartialResult(problem)
    base = fit_baseline(problem, known)
    terms = known.candidates[1]
    basis = basis_of(base.fit, len({term.key for term in terms}), problem.options.declared, settings)
    alone = base.fit if base.free is None else base.free
    return Case(simulation, alone, base.fit, terms, basis, settings)


def best_of(fits: Sequence[FittedModel], case: Case) -> ScoredFit:
    """Return the fit with the highest score, of all fits as they are and of the best also under its process noise."""
    found = [ScoredFit(fit, score(fit, case.basis, case.settings)) for fit in fits]
    best = max(found, key=lambda scored: scored.value)
    try:
        noisy = fit_with_process_noise(best.fit, dict(case.basis.declared), case.settings.noise).fit
    except NoFitError:
        return best
    return max([best, ScoredFit(noisy, score(noisy, case.basis, case.settings))], key=lambda scored: scored.value)


def known_fits(known: KnownSet, case: Case, returned: FittedModel | None) -> list[FittedModel]:
    """Return fits of the known set: from the shapes by hand, from the grid, and from the returned fit.

    Args:
        known: the effects.
        case: the recording.
        returned: the fit of the returned set; None without a model.
    """
    groups = suspected_terms(known.suspect, case.terms, case.alone.model.prepared)
    by_hand = [_with_shapes(group, known) for group in groups]
    beam = BeamSearch(case.terms, case.basis, case.settings, case.basis.declared)
    fits = [added(case.alone, by_hand, case), beam.fitted_set(groups, case.alone, "known").fit]
    if returned is not None:
        fits += _from_returned(returned, by_hand, case)
    return fits


def added(fit: FittedModel, groups: Sequence[Sequence[Term]], case: Case) -> FittedModel:
    """Return a fit with more effects, added one after the other, each from the best of its shapes."""
    for group in groups:
        [addition] = additions(fit, group, case.settings.noise)[:1]
        fits = [shape_fitted(begun) for term, size in addition.starts for begun in _begun(fit, term, size)]
        fit = max(fits, key=lambda found: found.log_likelihood)
    return fit


def _begun(fit: FittedModel, term: Term, size: torch.Tensor) -> Iterator[FittedModel]:
    for start in (size, torch.zeros_like(size)):
        yield fitted_with_effect(fit, fit.model.with_term(term), torch.cat([fit.parameters, start]), graduate=False)


def _with_shapes(group: Sequence[Term], known: KnownSet) -> list[Term]:
    """Return an effect's candidates with the shape of the fit by hand, or all of them if none is known."""
    by_hand = known.shapes.get(group[0].effect.id)
    if by_hand is None:
        return list(group)
    # other numbers of the shape, such as a width, keep their values on the grid
    fitting = [replace(term, shape={**term.shape, **by_hand}) for term in group if by_hand.keys() <= term.shape.keys()]
    return list({(term.key, *sorted(term.shape.items())): term for term in fitting}.values())


def _from_returned(returned: FittedModel, groups: Sequence[Sequence[Term]], case: Case) -> Iterator[FittedModel]:
    """Yield the fit of the known set from the returned parameters of the effects that both sets have."""
    model = returned.model
    gammas = dict(zip((term.key for term in model.terms), model.gammas(returned.parameters), strict=True))
    keys = [{term.key for term in group} for group in groups]
    both = [term for term in model.terms if any(term.key in own for own in keys)]
    if not both:
        return
    start = torch.cat([returned.parameters[: model.base], *[gammas[term.key] for term in both]])
    try:
        fit = fitted(JointModel(model.prepared, both, model.near), start, None, graduate=False, fresh=True)
    except NoFitError:
        return
    known = {term.key for term in both}
    left = [group for group, own in zip(groups, keys, strict=True) if not own & known]
    yield added(shape_fitted(fit), left, case)


def returned_fit(model: Path, case: Case) -> FittedModel | None:
    """Return the open-loop fit of a model.json from its parameters; None without effects or without a fit.

    Raises:
        ValueError: an effect of the file is no candidate of the recording.
    """
    if not model.is_file():
        return None
    found = DiagnosedModel.from_json(model.read_text(encoding="utf-8"), CATALOGUE, case.simulation)
    if not found.terms:
        return None
    prepared = case.alone.model.prepared.with_input_hold(found.state.get("input_hold", {})).open_loop()
    terms = [_with_driver(term, case) for term in found.terms]
    start = torch.cat([found.theta.detach(), *[gamma.detach().flatten() for gamma in found.gammas]])
    try:
        fit = fitted(JointModel(prepared, terms), start, None, graduate=False, fresh=True)
    except NoFitError:
        return None
    return shape_fitted(fit)


def _with_driver(term: Term, case: Case) -> Term:
    """Return an effect of a file with the recorded values of its driver."""
    same = [other for other in case.terms if other.key == term.key]
    if not same:
        raise ValueError(f"{term.effect.id} at {term.port} is no candidate of this recording.")
    return replace(term, driver=same[0].driver)
