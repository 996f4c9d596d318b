"""The third stage of a diagnosis: the stepwise search, its noise model and its step of integration."""

from __future__ import annotations

from dataclasses import replace

import torch

from mkc_torch.diagnosis.goodness_of_fit import poor_fits
from mkc_torch.diagnosis.model.process_noise import ProcessNoiseFit, estimate_noise, noise_of_fit
from mkc_torch.diagnosis.pipeline.baseline import fit_baseline
from mkc_torch.diagnosis.pipeline.build import assess_baseline, impossible_rotations
from mkc_torch.diagnosis.pipeline.partial import PartialResult
from mkc_torch.diagnosis.pipeline.prepare import Problem
from mkc_torch.diagnosis.pipeline.stepwise import StepwiseSearch, first_step, next_step
from mkc_torch.diagnosis.search.estimate import with_smaller_step


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
    terms = known.candidates[1]
    if poor_fits(assess_baseline(baseline, options.declared), options.settings.evidence.followed):
        # a poor fit may lack a single effect; further findings wait until the simulation fits with it
        known.options = options = replace(options, max_findings=min(options.max_findings, 1))
    progress(f"trying {len(terms)} effects")
    terms = () if impossible_rotations(baseline) else terms
    search = first_step(baseline.fit, terms, options, generator, baseline.free, known.keep_search)
    better = _under_better_noise(baseline, search, known)
    if better is not None:
        progress(f"trying {len(terms)} effects under a more likely noise model")
        known.keep_baseline(better, with_noise=True)
        search = first_step(better.fit, terms, options, generator, better.free, known.keep_search)
    finer = with_smaller_step(search.found[-1].fit, options.settings.noise) if search.found else None
    if finer is not None:
        return stepwise_search(problem, known, fit_baseline(problem, known, finer))
    known.keep_search(search)
    while search.left:
        progress(f"trying {len(search.left)} effects in addition to {len(search.found)} found")
        before, search = search, next_step(search, options, generator, known.keep_search)
        known.keep_search(search)
        if search.found == before.found:
            break
    return search


def _under_better_noise(
    baseline: ProcessNoiseFit, search: StepwiseSearch, known: PartialResult
) -> ProcessNoiseFit | None:
    """Return the baseline under the noise that the search found with its candidate; None if it is not more likely."""
    fit = None if search.first is None else search.first.without_candidate
    if fit is None:
        return None
    declared, settings = known.options.declared, known.options.settings
    noise = estimate_noise(fit, declared, settings.noise, noise_of_fit(fit, declared))
    return None if noise is None or noise.observer is None else replace(baseline, fit=fit, noise=noise)
