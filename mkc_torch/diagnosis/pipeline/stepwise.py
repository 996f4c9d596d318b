"""Stepwise search of simulations without states: one search after another, each with the previous findings."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch

from mkc_torch.diagnosis.evidence.common_cause import course_without, located_cause
from mkc_torch.diagnosis.evidence.held_out import (
    Evidence,
    HeldOutBlocks,
    blocks_of,
    gain_interval,
    held_out,
    on_all,
)
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.noise.spectrum import correlation_time, innovation_gain
from mkc_torch.diagnosis.pipeline.prepare import SearchOptions
from mkc_torch.diagnosis.pipeline.simpler_form import (
    simplified,
    with_driver_or_time,
)
from mkc_torch.diagnosis.pipeline.steps import StepwiseSearch
from mkc_torch.diagnosis.search.ranking import is_hardly_visible, is_repeated, near_onset
from mkc_torch.diagnosis.search.run import SearchResult, run_search, screening_p_value
from mkc_torch.diagnosis.settings import ConfirmationSettings
from mkc_torch.nonlinear import NoFitError


def _holds(
    located: SearchResult,
    before: Evidence,
    after: Evidence,
    blocks: HeldOutBlocks,
    seed: int,
    settings: ConfirmationSettings,
    *,
    first: bool,
) -> bool:
    """Whether a candidate counts as a finding.

    Held-out blocks weigh samples as if their noise was white, and can miss a clear effect in coloured noise. So a first
    finding, which has passed the surrogates, needs one of three: a positive gain on the blocks; no clear loss there, if
    it is clearly beyond all surrogates; or a gain above its number of parameters once the noise is whitened. A further
    finding may also fit the misfit of the previous finding's shape, so the blocks have to confirm it, or show a
    positive gain if it is far beyond all surrogates.
    """
    difference = after.log_likelihood - before.log_likelihood
    gain, (low, high) = gain_interval(difference, blocks.block, torch.Generator().manual_seed(seed))
    if first:
        plain = located.beyond > settings.beyond_doubt and high > 0.0
        price = 0.5 * located.fit.model.sizes[-1] * math.log(len(after.log_likelihood))
        return gain > 0.0 or plain or innovation_gain(before.residual, after.residual, located.fit.recorded) > price
    return low > 0.0 or (gain > 0.0 and located.beyond > settings.further)


Keep = Callable[[StepwiseSearch], object]
"""A callback that receives the search so far, in case it is stopped."""


def first_step(
    base: FittedModel,
    terms: tuple[Term, ...],
    options: SearchOptions,
    generator: torch.Generator,
    keep: Keep = lambda _: None,
) -> StepwiseSearch:
    """Run the first search; its candidate is a finding if held-out blocks confirm it.

    After a refused candidate the search is repeated once without its effect.

    ``keep`` is called with the search so far.
    """
    so_far = search_before(base, terms, options)
    blocks, first = so_far.blocks, None
    keep(so_far)
    if terms:
        first = _located(base, terms, options, generator, keep=lambda first: keep(replace(so_far, first=first)))
    keep(replace(so_far, first=first))
    evidence = held_out(base, blocks) if options.judged else on_all(base)
    first_step = StepwiseSearch(first, (), None, blocks, (evidence,), terms)
    keep(first_step)
    if first is None:
        return first_step
    taken = _add(first_step, base, first, options, lambda left: _located(base, left, options, generator))
    keep(taken)
    cause = None
    if taken.first is not None and not taken.found and not options.quick:
        cause = located_cause(base, taken.first, options.level, options.surrogates)
    if cause is None:
        return taken
    try:
        after = held_out(cause.fit, blocks, partial(course_without, base, cause))
    except NoFitError:  # without a part of the recording there is no such course
        return taken
    # after a free course, little structure remains
    return replace(accept(replace(taken, first=cause), base, cause, options, after), left=())


def search_before(base: FittedModel, terms: tuple[Term, ...], options: SearchOptions) -> StepwiseSearch:
    """Return the search before its first step, without evidence."""
    correlation = max(correlation_time(series) for series in base.pseudo(options.settings.noise)[0].unbind(1))
    blocks = blocks_of(len(base.residual), math.ceil(correlation), options.settings.confirmation)
    return StepwiseSearch(None, (), None, blocks, (), terms)


def next_step(
    search: StepwiseSearch, options: SearchOptions, generator: torch.Generator, keep: Keep = lambda _: None
) -> StepwiseSearch:
    """Run the next search with the findings in the model; skip it if the screening shows nothing.

    After a refused candidate the search is repeated once without its effect.
    """
    if _is_screened_out(search, options):
        return replace(search, left=())
    fit = search.found[-1].fit
    try:
        located = _located(fit, search.left, options, generator, parts=False)
        again = partial(_located, fit, options=options, generator=generator, parts=False)
        taken = _add(search, fit, located, options, again)
        keep(taken)
        return taken
    except NoFitError as error:
        return replace(search, left=(), given_up=str(error))  # keep the previous findings


def _add(
    search: StepwiseSearch,
    fit: FittedModel,
    located: SearchResult,
    options: SearchOptions,
    again: Callable[[tuple[Term, ...]], SearchResult] | None = None,
) -> StepwiseSearch:
    """Add a located candidate if it counts as a finding and is visible.

    ``again`` searches once more, without the effect of a refused candidate.
    """
    if located.p_value <= options.level and is_hardly_visible(located.fit):
        less = replace(search, left=(), refused=(*search.refused, located))
        left = tuple(term for term in search.left if term.key != located.term.key)
        if again is None or not left:
            return less
        further = again(left)
        less = replace(less, left=search.left, first=search.first if search.found else further)
        return _add(less, fit, further, options)
    try:
        return accept(search, fit, located, options)
    except NoFitError:
        if search.found:
            raise
        return replace(search, left=(), unconfirmed=located)  # a fit to a part has no finite trajectory


def _located(
    fit: FittedModel,
    terms: tuple[Term, ...],
    options: SearchOptions,
    generator: torch.Generator,
    *,
    parts: bool = True,
    keep: Callable[[SearchResult], object] = lambda _: None,
) -> SearchResult:
    return run_search(
        fit,
        terms,
        level=options.level,
        surrogates=options.surrogates,
        generator=generator,
        settings=options.settings,
        parts=parts and not options.quick,
        quick=options.quick,
        keep=keep,
    )


def _is_screened_out(search: StepwiseSearch, options: SearchOptions) -> bool:
    """Whether the screening p-value after the last finding is too large for a further finding.

    After a line there is always a further search: with the line in the residual, its noise is another.
    """
    if search.found[-1].term.effect.by_periodogram:
        return False
    return _further_p_value(search, options) > max(options.settings.confirmation.screening_level, options.level)


def _further_p_value(search: StepwiseSearch, options: SearchOptions) -> float:
    """The p-value of the screening after the last finding."""
    last, settings = search.found[-1], options.settings
    near = near_onset(last.fit, settings)
    others = [
        all(not is_repeated(term, known.term, near, settings) for known in search.found) for term in last.scene.terms
    ]
    generator = torch.Generator().manual_seed(options.seed)
    return screening_p_value(last, others, settings.confirmation.screening_draws, generator, quick=options.quick)


def _shows_more(search: StepwiseSearch, options: SearchOptions) -> bool:
    """Whether the screening shows a further finding; False if it cannot see any (p-value 0)."""
    if search.found[-1].term.effect.by_periodogram:
        return False
    return not options.quick and 0.0 < _further_p_value(search, options) <= options.level


def accept(
    search: StepwiseSearch,
    previous: FittedModel,
    located: SearchResult,
    options: SearchOptions,
    after: Evidence | None = None,
) -> StepwiseSearch:
    """Add a located candidate if it counts as a finding.

    ``after`` is its evidence if that is not the evidence of its fit.
    """
    over = replace(search, left=())
    if located.p_value > options.level or options.max_findings == 0:
        return over
    if after is None and not options.quick:
        located = with_driver_or_time(previous, located, options.settings)
    before = search.evidence[-1]
    if after is None:
        after = held_out(located.fit, search.blocks)

    def holds(fit: FittedModel, evidence: Evidence) -> bool:
        candidate = replace(located, fit=fit)
        confirmation = options.settings.confirmation
        return _holds(candidate, before, evidence, search.blocks, options.seed, confirmation, first=not search.found)

    if not holds(located.fit, after):
        return replace(over, unconfirmed=located)
    if len(search.found) == options.max_findings:
        return replace(over, cut=True)
    fit, after = simplified(located.fit, after, search.blocks, holds, options.settings.naming)
    found = (*search.found, replace(located, fit=fit, term=fit.model.terms[-1]))
    near = near_onset(located.fit, options.settings)
    known = (located.term, *fit.model.terms)  # a simpler form may have replaced the located effect
    left = tuple(t for t in search.left if not any(is_repeated(t, own, near, options.settings) for own in known))
    taken = replace(search, found=found, evidence=(*search.evidence, after), left=left)
    full = len(found) == options.max_findings and not _shows_more(taken, options)
    return replace(taken, left=()) if full else taken
