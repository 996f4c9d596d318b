"""Stepwise search: one search after another, each with the previous findings in the model."""

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
    better_supported,
    blocks_of,
    gain_interval,
    held_out,
    on_all,
)
from mkc_torch.diagnosis.findings.finding import ended_shapes
from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.process_noise import (
    first_samples,
    has_process_noise,
    refit_input_hold,
    refit_open_loop,
)
from mkc_torch.diagnosis.model.shapes import within_a_sample
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.noise.spectrum import correlation_time, innovation_gain
from mkc_torch.diagnosis.pipeline.prepare import SearchOptions
from mkc_torch.diagnosis.pipeline.simpler_form import (
    in_better_order,
    simpler_by_price,
    simplified,
    with_driver_or_time,
    with_special_case,
)
from mkc_torch.diagnosis.pipeline.steps import StepwiseSearch, eliminated, exchanged, with_fit
from mkc_torch.diagnosis.search.own_noise import priced
from mkc_torch.diagnosis.search.partner import is_undetermined, with_partner
from mkc_torch.diagnosis.search.ranking import Ranked, enlarges_open_loop, is_hardly_visible, is_repeated, near_onset
from mkc_torch.diagnosis.search.run import SearchResult, run_search, screening_p_value
from mkc_torch.diagnosis.search.with_process_noise import search_with_process_noise
from mkc_torch.diagnosis.settings import ConfirmationSettings, Settings
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
    it is clearly beyond all surrogates; or a gain above its number of parameters once the noise is whitened. If noise
    and physics were selected together, the blocks can only reject a first finding, because process noise predicts one
    step ahead as well. A further finding may also fit the misfit of the previous finding's shape, so the blocks have to
    confirm it, or show a positive gain if it is far beyond all surrogates.
    """
    difference = after.log_likelihood - before.log_likelihood
    gain, (low, high) = gain_interval(difference, blocks.block, torch.Generator().manual_seed(seed))
    if first and located.with_noise:
        return high >= 0.0
    if first:
        plain = located.beyond > settings.beyond_doubt and high > 0.0
        price = 0.5 * located.fit.model.sizes[-1] * math.log(len(after.log_likelihood))
        return gain > 0.0 or plain or innovation_gain(before.residual, after.residual) > price
    return low > 0.0 or (gain > 0.0 and located.beyond > settings.further)


Keep = Callable[[StepwiseSearch], object]
"""A callback that receives the search so far, in case it is stopped."""


def first_step(
    base: FittedModel,
    terms: tuple[Term, ...],
    options: SearchOptions,
    generator: torch.Generator,
    free: FittedModel | None = None,
    keep: Keep = lambda _: None,
) -> StepwiseSearch:
    """Run the first search; its candidate is a finding if held-out blocks confirm it.

    After a refused candidate the search is repeated once without its effect.

    ``keep`` is called with the search so far.
    """
    prepared = base.model.prepared
    correlation = max(correlation_time(series) for series in base.pseudo(options.settings.noise)[0].unbind(1))
    confirmation = options.settings.confirmation
    blocks = blocks_of(len(base.residual), math.ceil(correlation), confirmation, first_samples(prepared))
    first = None
    so_far = StepwiseSearch(None, (), None, blocks, (), terms)
    keep(so_far)
    if terms:
        first = _located(
            base, terms, options, generator, free=free, keep=lambda first: keep(replace(so_far, first=first))
        )
    keep(replace(so_far, first=first))
    evidence = _evidence(base, blocks, options)
    first_step = StepwiseSearch(first, (), None, blocks, (evidence,), terms)
    keep(first_step)
    if first is None:
        return first_step
    taken = _add(first_step, base, first, options, lambda left: _located(base, left, options, generator, free=free))
    keep(taken)
    cause = None
    if taken.first is not None and not taken.found and not options.quick:
        cause = located_cause(base, taken.first, options.level, options.surrogates)
    if cause is not None:
        try:
            after = held_out(cause.fit, blocks, partial(course_without, base, cause))
        except NoFitError:  # without a part of the recording there is no such course
            return taken
        # after a free course, little structure remains
        return replace(_accept(replace(taken, first=cause), base, cause, options, after), left=())
    return _with_another(first_step, taken, options, generator, free) if taken.found else taken


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
        return _with_another(search, taken, options, generator)
    except NoFitError as error:
        return replace(search, left=(), given_up=str(error))  # keep the previous findings


def _add(
    search: StepwiseSearch,
    fit: FittedModel,
    located: SearchResult,
    options: SearchOptions,
    again: Callable[[tuple[Term, ...]], SearchResult] | None = None,
) -> StepwiseSearch:
    """Add a located candidate if it counts as a finding, is visible, and does not enlarge the open-loop residual.

    ``again`` searches once more, without the effect of a refused candidate.
    """
    refused = is_hardly_visible(located.fit) or (bool(search.found) and enlarges_open_loop(located.fit, fit))
    if located.p_value <= options.level and refused:
        less = replace(search, left=(), refused=(*search.refused, located))
        left = tuple(term for term in search.left if term.key != located.term.key)
        if again is None or not left:
            return less
        further = again(left)
        less = replace(less, left=search.left, first=search.first if search.found else further)
        return _add(less, fit, further, options)
    try:
        return _accept(search, fit, located, options)
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
    free: FittedModel | None = None,
    keep: Callable[[SearchResult], object] = lambda _: None,
) -> SearchResult:
    if has_process_noise(fit):
        return search_with_process_noise(
            fit,
            terms,
            level=options.level,
            surrogates=options.surrogates,
            generator=generator,
            declared=options.declared,
            fixed=options.fixed,
            free=refit_open_loop(fit) if fit.model.terms else free,
            settings=options.settings,
            quick=options.quick,
            keep=keep,
        )
    located = run_search(
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
    if options.quick or located.p_value > options.level:
        return located
    held = refit_input_hold(located.fit, options.declared, options.fixed, options.settings.noise)
    return located if held is located.fit else replace(located, fit=held, term=held.model.terms[-1])


def _is_screened_out(search: StepwiseSearch, options: SearchOptions) -> bool:
    """Whether the screening p-value after the last finding is too large for a further finding."""
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


def _evidence(fit: FittedModel, blocks: HeldOutBlocks, options: SearchOptions) -> Evidence:
    """Evidence of a fit on held-out blocks, or on all samples if the blocks are not used."""
    return held_out(fit, blocks) if options.judged else on_all(fit)


def _shows_more(search: StepwiseSearch, options: SearchOptions) -> bool:
    """Whether the screening shows a further finding; False if it cannot see any (p-value 0)."""
    return not options.quick and 0.0 < _further_p_value(search, options) <= options.level


def _accept(
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
    if not located.with_noise and after is None and not options.quick:
        located = with_driver_or_time(previous, located, options.settings)
    if located.with_noise and after is None and options.judged and not options.quick:
        scores = partial(_evidence, blocks=search.blocks, options=options)
        located = with_special_case(located, scores, search.blocks, options.seed, options.settings.naming)
    ordered = in_better_order(located.fit, options.declared, options.settings)
    if ordered is not located.fit:
        located, after = replace(located, fit=ordered, term=ordered.model.terms[-1]), None
    before = search.evidence[-1]
    if after is None:
        after = _evidence(located.fit, search.blocks, options)

    def holds(fit: FittedModel, evidence: Evidence) -> bool:
        candidate = replace(located, fit=fit)
        return _holds(
            candidate,
            before,
            evidence,
            search.blocks,
            options.seed,
            options.settings.confirmation,
            first=not search.found,
        )

    same = None if located.with_noise else _under_theis_repeated(previous, located.fit)
    paired = (
        after
        if same is None
        else better_supported(before, (held_out(same, search.blocks), after), search.blocks, options.seed)
    )
    if within_a_sample(located.term, located.fit.model.prepared) or not holds(located.fit, paired):
        return replace(over, unconfirmed=located)
    if len(search.found) == options.max_findings:
        return exchanged(search, located, options) or replace(over, cut=True)
    fit, simpler = located.fit, after
    if located.with_noise:
        fit = simpler_by_price(located.fit, options.declared, options.settings)
        simpler = after if fit is located.fit else _evidence(fit, search.blocks, options)
    else:
        fit, simpler = simplified(located.fit, after, search.blocks, holds, options.settings.naming)
    paired = simpler if same is None or fit is not located.fit else paired
    after = simpler
    found = (*search.found, replace(located, fit=fit, term=fit.model.terms[-1]))
    near = near_onset(located.fit, options.settings)
    known = (located.term, *fit.model.terms)  # a simpler form may have replaced the located effect
    left = tuple(t for t in search.left if not any(is_repeated(t, own, near, options.settings) for own in known))
    pairs = (*search.pairs, (before, paired))
    taken = replace(search, found=found, evidence=(*search.evidence, after), pairs=pairs, left=left)
    if located.with_noise:
        taken = eliminated(taken, options)
    found = taken.found
    full = len(found) == options.max_findings and not _shows_more(taken, options)
    return replace(taken, left=()) if full else taken


def _with_another(
    before: StepwiseSearch,
    after: StepwiseSearch,
    options: SearchOptions,
    generator: torch.Generator,
    free: FittedModel | None = None,
) -> StepwiseSearch:
    """Add to the last finding the effect that it needs, or that it stands for in part.

    Args:
        before: the search without the last finding.
        after: the search with it.
        options: of the diagnosis.
        generator: of the surrogates.
        free: the open-loop fit of the simulation without findings.
    """
    try:
        paired = _with_partner(before, after, options, free)
    except NoFitError:
        paired = after
    return paired if paired is not after else _in_two_steps(before, after, options, generator)


def _with_partner(
    before: StepwiseSearch, after: StepwiseSearch, options: SearchOptions, free: FittedModel | None
) -> StepwiseSearch:
    """Add a partner to a last finding whose size is not determined, if the two together pay their price.

    Held-out blocks can only reject the pair, as they can a first finding.
    """
    settings, count = options.settings, len(after.found)
    room = len(before.found) < count < options.max_findings
    if options.quick or not room or not after.found[-1].with_noise:
        return after
    last = after.found[-1]
    free = before.found[-1].fit.open_loop if before.found else free
    if free is None or not is_undetermined(last.fit, settings.noise):
        return after
    pair = with_partner(last, free, options.declared, settings)
    if pair is None or enlarges_open_loop(pair, last.fit):
        return after
    term = pair.model.terms[-1]
    number = next(number for number, other in enumerate(last.scene.terms) if other.key == term.key)
    gain = pair.log_likelihood - last.fit.log_likelihood
    partner = replace(last, term=term, fit=pair, ranking=(Ranked(number, gain, 0.0),), compared=())
    both = with_fit(after, (*after.found, partner), pair, options)
    if both is None:
        return after
    difference = both.evidence[-1].log_likelihood - before.evidence[-1].log_likelihood
    high = gain_interval(difference, before.blocks.block, torch.Generator().manual_seed(options.seed))[1][1]
    if high < 0.0:
        return after
    both = eliminated(replace(both, left=tuple(t for t in after.left if t.key != term.key)), options)
    return replace(both, left=()) if len(both.found) == options.max_findings else both


def _in_two_steps(
    before: StepwiseSearch, after: StepwiseSearch, options: SearchOptions, generator: torch.Generator
) -> StepwiseSearch:
    """Replace the last finding by a simpler effect and a further finding if the two together score as well.

    A form with more numbers can stand for two effects: friction that falls with speed for dry friction and drag. So can
    a shape parameter that ended at a bound: a power of the speed near 0 for dry friction and drag.

    Args:
        before: the search without the last finding.
        after: the search with it.
        options: of the diagnosis.
        generator: of the surrogates.
    """
    settings = options.settings
    if options.quick or len(after.found) != len(before.found) + 1 or not after.left or not after.found[-1].with_noise:
        return after
    last = after.found[-1]
    near = _simpler_rivals(last)
    if not near:
        return after
    simple = max(near, key=lambda fit: priced(fit, settings))
    try:
        further = _located(simple, after.left, options, generator, parts=False)
    except NoFitError:
        return after
    if further.p_value > options.level or _score(further.fit, settings) < _score(last.fit, settings):
        return after
    first = replace(last, fit=simple, term=simple.model.terms[-1])
    evidence = held_out(simple, before.blocks)
    step = replace(
        after,
        found=(*before.found, first),
        evidence=(*before.evidence, evidence),
        pairs=(*before.pairs, (before.evidence[-1], evidence)),
    )
    both = _accept(step, simple, further, options)
    return both if len(both.found) > len(after.found) else after


def _simpler_rivals(last: SearchResult) -> list[FittedModel]:
    """Return the compared fits of simpler effects that may stand for a part of a finding."""
    effect, port = last.term.effect, last.term.port
    if effect.reduces_to is not None:
        return [fit for fit in last.compared if fit.model.terms[-1].effect.id == effect.reduces_to.id]
    if not ended_shapes(last.term, last.fit.model.prepared):
        return []
    rivals = [fit for fit in last.compared if fit.model.terms[-1].port == port]
    return [fit for fit in rivals if _numbers(fit) < _numbers(last.fit) and not fit.model.terms[-1].effect.is_curve]


def _numbers(fit: FittedModel) -> int:
    """Number of fitted sizes and shape parameters of the effects."""
    return fit.model.size + sum(len(term.effect.fitted_shape) for term in fit.model.terms)


def _score(fit: FittedModel, settings: Settings) -> float:
    """Log-likelihood less the penalty of the noise, and Schwarz's penalty of the effects' sizes and shapes."""
    return priced(fit, settings) - 0.5 * math.log(len(fit.residual)) * _numbers(fit)


def _under_theis_repeated(previous: FittedModel, fit: FittedModel) -> FittedModel | None:
    """Refit a finding under the process noise of the fit without it, for comparison; None if the noise is equal."""
    if not has_process_noise(previous) or fit.model.prepared is previous.model.prepared:
        return None
    model = JointModel(previous.model.prepared, fit.model.terms, previous.model.near)
    try:
        return fitted(model, fit.parameters, previous.bound, graduate=False)
    except NoFitError:
        return None
