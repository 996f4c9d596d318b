"""The second and third stages of a diagnosis: the fit of the simulation, and the stepwise search."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch

from mkc_torch.diagnosis.goodness_of_fit import poor_fits
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.process_noise import (
    ProcessNoiseFit,
    choose_input_hold,
    estimate_noise,
    fit_alone,
    noise_of_fit,
)
from mkc_torch.diagnosis.pipeline.build import assess_baseline, impossible_rotations
from mkc_torch.diagnosis.pipeline.partial import PartialResult
from mkc_torch.diagnosis.pipeline.prepare import Problem
from mkc_torch.diagnosis.pipeline.scores import with_scores
from mkc_torch.diagnosis.pipeline.steps import StepwiseSearch, eliminated, revised
from mkc_torch.diagnosis.pipeline.stepwise import first_step, next_step
from mkc_torch.diagnosis.search.estimate import with_smaller_step
from mkc_torch.simulation.protocol import PreparedSimulation


def stepwise_search(problem: Problem, known: PartialResult, baseline: ProcessNoiseFit) -> StepwiseSearch:
    """Search for effects one after another, each with the previous findings in the model.

    Args:
        problem: the input of the diagnosis.
        known: receives the search so far, and the baseline if the search finds a more likely noise model or needs a
            smaller step of integration.
        baseline: the fit without findings.
    """
    search = _searched(problem, known, baseline)
    if known.base.model.prepared.dynamics is None:
        return search
    scored = partial(with_scores, search, known.fitted_baseline, known.candidates[1], known.options)
    problem.progress("scoring the findings")
    search = known.improved("scoring the findings", scored, search)
    known.keep_search(search)
    return search


def _searched(problem: Problem, known: PartialResult, baseline: ProcessNoiseFit) -> StepwiseSearch:
    """Search for effects; again at half the step of integration if the first finding depends on it."""
    options, progress = known.options, problem.progress
    generator = torch.Generator().manual_seed(options.seed)
    terms = known.candidates[1]
    if poor_fits(assess_baseline(baseline, options.declared), options.settings.evidence.followed):
        # a poor fit may lack a single effect; further findings wait until the simulation fits with it
        known.options = options = replace(options, max_findings=min(options.max_findings, 1))
    progress(f"trying {len(terms)} effects")
    terms = () if impossible_rotations(baseline) else terms
    first = partial(first_step, baseline.fit, terms, options, generator, baseline.free, known.keep_search)
    search = known.continued("confirming the first finding", first)
    under_better_noise = partial(_under_better_noise, baseline, search, known, generator, progress)
    search = known.improved("trying effects under a more likely noise model", under_better_noise, search)
    at_smaller_step = partial(_at_smaller_step, problem, known, search)
    repeated = known.improved("halving the step of integration", at_smaller_step, search)
    if repeated is not search:
        return repeated
    known.keep_search(search)
    while search.left:
        stage = f"trying {len(search.left)} effects in addition to {len(search.found)} found"
        progress(stage)
        further = partial(next_step, search, options, generator, known.keep_search)
        before, search = search, known.continued(stage, further, search)
        known.keep_search(search)
        if search.found == before.found:
            break
    if len(search.found) > 1:
        stage = "comparing the findings again with their rivals"
        progress(stage)
        search = known.improved(stage, partial(revised, search, options), search)
        search = known.improved(
            "removing findings that the others replace", partial(eliminated, search, options), search
        )
        known.keep_search(search)
    return search


def _under_better_noise(
    baseline: ProcessNoiseFit,
    search: StepwiseSearch,
    known: PartialResult,
    generator: torch.Generator,
    progress: Callable[[str], object],
) -> StepwiseSearch:
    """Repeat the first search under the noise that it found with its candidate, if that is more likely."""
    fit = None if search.first is None else search.first.without_candidate
    if fit is None:
        return search
    options = known.options
    noise = estimate_noise(fit, options.declared, options.settings.noise, noise_of_fit(fit, options.declared))
    if noise is None or noise.observer is None:
        return search
    better, terms = replace(baseline, fit=fit, noise=noise), known.candidates[1]
    progress(f"trying {len(terms)} effects under a more likely noise model")
    known.keep_baseline(better, with_noise=True)
    return first_step(better.fit, terms, options, generator, better.free, known.keep_search)


def _at_smaller_step(problem: Problem, known: PartialResult, search: StepwiseSearch) -> StepwiseSearch:
    """Repeat the whole search with half the step of integration, if the finding depends on the step."""
    finer = with_smaller_step(search.found[-1].fit, known.options.settings.noise) if search.found else None
    return search if finer is None else _searched(problem, known, fit_baseline(problem, known, finer))


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
        baseline = choose_input_hold(baseline, declared, options.fixed, noise)
        known.keep_baseline(baseline, with_noise=True)
        _refuse_no_noise(baseline.fit, problem.where)
        finer = with_smaller_step(baseline.fit, noise)
        if finer is None:
            return baseline
        prepared = finer


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
