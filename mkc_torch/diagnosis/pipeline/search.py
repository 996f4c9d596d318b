"""The second and third stages of a diagnosis: the fit of the simulation, and the stepwise search."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch

from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.process_noise import (
    ProcessNoiseFit,
    at_half_step,
    choose_input_hold,
    fit_alone,
)
from mkc_torch.diagnosis.pipeline.build import impossible_rotations
from mkc_torch.diagnosis.pipeline.lines import first_line_step, line_candidates, line_step
from mkc_torch.diagnosis.pipeline.model_search import search_models, with_step_of
from mkc_torch.diagnosis.pipeline.partial import PartialResult
from mkc_torch.diagnosis.pipeline.prepare import Problem, SearchOptions
from mkc_torch.diagnosis.pipeline.steps import StepwiseSearch
from mkc_torch.diagnosis.pipeline.stepwise import next_step
from mkc_torch.diagnosis.score import basis_of, highest
from mkc_torch.diagnosis.search.estimate import with_smaller_step
from mkc_torch.nonlinear import NoFitError
from mkc_torch.simulation.protocol import PreparedSimulation


def stepwise_search(problem: Problem, known: PartialResult, baseline: ProcessNoiseFit) -> StepwiseSearch:
    """Search for effects one after another, each with the previous findings in the model.

    Args:
        problem: the input of the diagnosis.
        known: receives the search so far, and the baseline if the search finds a more likely noise model or needs a
            smaller step of integration.
        baseline: the fit without findings.
    """
    options, progress = known.options, problem.progress
    generator = torch.Generator().manual_seed(options.seed)
    terms = () if impossible_rotations(baseline) else known.candidates[1]
    progress(f"trying {len(terms)} effects")
    lines = partial(line_candidates, drivers=known.candidates[0].drivers, effects=known.effects, options=options)
    if baseline.fit.model.prepared.dynamics is not None:
        whole = partial(search_models, baseline, terms, options, generator, known.keep_and_report, lines, progress)
        search = known.continued("searching models", whole)
        repeated = known.improved("halving the step of integration", partial(at_smaller_step, known, search), search)
        known.keep_search(repeated)
        return repeated
    first = partial(first_line_step, baseline.fit, terms, options, generator, known.keep_and_report, lines)
    search = known.continued("confirming the first finding", first)
    known.keep_search(search)
    while search.left:
        stage = f"trying {len(search.left)} effects in addition to {len(search.found)} found"
        progress(stage)
        further = partial(next_step, search, options, generator, known.keep_and_report)
        before, search = search, known.continued(stage, further, search)
        known.keep_search(search)
        if search.found == before.found:
            break
    if search.found and not search.cut and len(search.found) < options.max_findings:
        last = partial(line_step, search, search.found[-1].fit, lines, options)
        search = known.continued("searching a period", last, search)
        known.keep_search(search)
    return search


def at_smaller_step(known: PartialResult, search: StepwiseSearch) -> StepwiseSearch:
    """Halve the step of integration and fit the findings again, as long as they depend on the step.

    Args:
        known: receives the fit of the simulation and the findings together, so that both have the same step.
        search: the search so far; returned if a fit at a smaller step loses the recording.
    """
    while search.found and with_smaller_step(search.found[-1].fit, known.options.settings.noise) is not None:
        try:
            baseline = at_half_step(known.fitted_baseline)
            if baseline is None:
                break
            search = with_step_of(search, baseline, known.options)
        except NoFitError:
            break
        known.restart()
        known.keep_baseline(baseline, with_noise=True)
        known.keep_search(search)
    return search


def fit_baseline(problem: Problem, known: PartialResult, prepared: PreparedSimulation | None = None) -> ProcessNoiseFit:
    """Fit the simulation without findings, with a step of integration on which the fit does not depend.

    Args:
        problem: the input of the diagnosis.
        known: receives the fits.
        prepared: the simulation with another step of integration; None for that of the problem.

    Raises:
        NoFitError: no start has a finite result.
        ValueError: a channel whose residual is constant.
    """
    prepared = problem.prepared if prepared is None else prepared
    options = known.options
    declared, noise = options.declared, options.settings.noise
    while True:
        known.restart()
        problem.progress("fitting the simulation alone")
        baseline = fit_alone(prepared, declared, noise, known.keep_baseline)
        baseline = choose_input_hold(baseline, declared, options.fixed, noise, _score_of(baseline, options))
        known.keep_baseline(baseline, with_noise=True)
        _refuse_no_noise(baseline.fit, problem.where)
        finer = with_smaller_step(baseline.fit, noise)
        if finer is None:
            return baseline
        prepared = finer


def _score_of(baseline: ProcessNoiseFit, options: SearchOptions) -> Callable[[ProcessNoiseFit], float]:
    """Return the score of fits that differ in the inputs' holds."""
    if not baseline.fit.model.prepared.input_hold:
        return lambda _: 0.0
    basis = basis_of(baseline.fit, 1, options.declared, options.settings)
    return lambda fits: highest((fits.free, fits.fit), basis, options.settings)


def _refuse_no_noise(base: FittedModel, where: str) -> None:
    """Raise ValueError for a channel whose residual is constant: no noise is left to test an effect against."""
    same = (base.residual == base.residual[:1]).all(0)
    nothing = base.d.square() < torch.finfo(base.d.dtype).tiny
    exact = (same | nothing).tolist()
    names = [name for name, is_exact in zip(base.model.prepared.channels, exact, strict=True) if is_exact]
    if names:
        raise ValueError(
            f"{where}`{names[0]}` differs from the simulation by the same number in every sample, so no noise is left "
            "to test effects against. Leave it out of the compared channels, or record it with its noise."
        )
