"""One search after the other, each beside what the ones before found."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import torch

from mkc_torch._parallel.pool import speculative
from mkc_torch.diagnosis.evidence.held_out import Evidence, HeldOutBlocks, blocks_of, gain_interval, held_out, on_all
from mkc_torch.diagnosis.evidence.simpler_form import simpler_by_price, simplified
from mkc_torch.diagnosis.evidence.unrecorded_cause import course_without, located_cause
from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.grid import within_a_sample
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.parallel import common_parts
from mkc_torch.diagnosis.model.process_noise import first_samples, with_noise_of_fit
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.noise.innovations import innovation_gain
from mkc_torch.diagnosis.noise.spectrum import correlation_time
from mkc_torch.diagnosis.search.elimination import needless_term, without
from mkc_torch.diagnosis.search.model_prior import alike
from mkc_torch.diagnosis.search.own_noise import priced
from mkc_torch.diagnosis.search.run import SearchResult, run_search
from mkc_torch.diagnosis.search.screening import p_value_beside
from mkc_torch.diagnosis.search.with_process_noise import search_with_process_noise
from mkc_torch.diagnosis.settings import ConfirmationSettings, Settings
from mkc_torch.nonlinear import NoFitError


@dataclass(frozen=True)
class SearchOptions:
    """The arguments of :func:`diagnose` that are numbers, or hold them.

    ``judged`` says whether blocks that the fits have not seen judge what is found.
    """

    level: float
    surrogates: int
    max_findings: int
    seed: int
    settings: Settings
    declared: Mapping[str, float] = field(default_factory=dict)
    fixed: Mapping[str, str] = field(default_factory=dict)
    quick: bool = False
    judged: bool = True


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
    """Whether what was found counts.

    Blocks weigh samples as if their noise was white, and miss what is plain in coloured noise: of the first finding,
    which the draws of noise have judged, they need only to lean its way, or not clearly the other way where it is plain
    beyond all draws; or to confirm it, by more than its number of parameters is worth, once the noise is filtered
    white. Where noise and physics were chosen together blocks only veto a first finding: one step ahead process noise
    predicts as well. What comes after a finding also has what that one's form left over, and they have to confirm it,
    or to lean its way where it is plain beyond all draws.
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


@dataclass(frozen=True)
class StepwiseSearch:
    """One search after the other: the first one, what was found, and what unseen blocks did not confirm.

    ``evidence`` is that of the simulation alone and with one finding more each, ``pairs`` that without and with each
    finding under the same pushes, by which it was confirmed; ``left`` are candidates that are still
    to be searched beside what was found, none once the search is over; ``given_up`` says why there was no next one, and
    ``cut`` that there was a further finding when as much was found as was asked for.
    """

    first: SearchResult | None
    found: tuple[SearchResult, ...]
    unconfirmed: SearchResult | None
    blocks: HeldOutBlocks
    evidence: tuple[Evidence, ...]
    left: tuple[Term, ...]
    pairs: tuple[tuple[Evidence, Evidence], ...] = ()
    given_up: str = ""
    cut: bool = False

    @property
    def parts(self) -> tuple[object, ...]:
        """What the next search goes on with."""
        fits = [located.fit for located in self.found]
        pairs = [one for pair in self.pairs for one in pair]
        return self.first, *self.found, *fits, *(fit.model for fit in fits), self.blocks, *self.evidence, *pairs


Keep = Callable[[StepwiseSearch], object]
"""What is called with a search so far, for it may be stopped before its end."""


def _kept_nowhere(_: StepwiseSearch) -> None:
    """Nobody asks for a search so far."""


def first_step(
    base: FittedModel,
    terms: tuple[Term, ...],
    asked: SearchOptions,
    generator: torch.Generator,
    free: FittedModel | None = None,
    keep: Keep = _kept_nowhere,
) -> StepwiseSearch:
    """The first search, and its finding, if unseen blocks confirm it; ``keep`` is called with what is known so far."""
    prepared = base.model.prepared
    correlation = max(correlation_time(one) for one in base.pseudo(asked.settings.noise)[0].unbind(1))
    confirmation = asked.settings.confirmation
    blocks = blocks_of(len(base.residual), math.ceil(correlation), confirmation, first_samples(prepared))
    first = None
    so_far = StepwiseSearch(None, (), None, blocks, (), terms)
    keep(so_far)
    with speculative([partial(_evidence, base, blocks, asked)], common_parts(prepared, ())) as judged:
        if terms:
            first = _located(
                base, terms, asked, generator, free=free, keep=lambda first: keep(replace(so_far, first=first))
            )
        keep(replace(so_far, first=first))
        [evidence] = judged()
    first_step = StepwiseSearch(first, (), None, blocks, (evidence,), terms)
    keep(first_step)
    if first is None:
        return first_step
    try:
        taken = _accept(first_step, base, first, asked)
    except NoFitError:  # a fit to a part of the recording is lost
        taken = replace(first_step, left=(), unconfirmed=first)
    keep(taken)
    if taken.found:
        return _in_two_steps(first_step, taken, asked, generator)
    if asked.quick:
        return taken
    cause = located_cause(base, first, asked.level, asked.surrogates)
    if cause is None:
        return taken
    after = held_out(cause.fit, blocks, partial(course_without, base, cause))
    # beside a course that may be any, little is left to be told
    return replace(_accept(replace(taken, first=cause), base, cause, asked, after), left=())


def next_step(
    search: StepwiseSearch, asked: SearchOptions, generator: torch.Generator, keep: Keep = _kept_nowhere
) -> StepwiseSearch:
    """The next search, beside what was found; none where a first look shows nothing."""
    if _screening_p_value(search, asked):
        return replace(search, left=())
    fit = search.found[-1].fit
    try:
        taken = _accept(search, fit, _located(fit, search.left, asked, generator, parts=False), asked)
        keep(taken)
        return _in_two_steps(search, taken, asked, generator)
    except NoFitError as error:
        return replace(search, left=(), given_up=str(error))  # what was found before is not to be lost


def _located(
    fit: FittedModel,
    terms: tuple[Term, ...],
    asked: SearchOptions,
    generator: torch.Generator,
    *,
    parts: bool = True,
    free: FittedModel | None = None,
    keep: Callable[[SearchResult], object] = lambda _: None,
) -> SearchResult:
    if with_noise_of_fit(fit):
        return search_with_process_noise(
            fit,
            terms,
            level=asked.level,
            surrogates=asked.surrogates,
            generator=generator,
            declared=asked.declared,
            fixed=asked.fixed,
            free=free,
            settings=asked.settings,
            quick=asked.quick,
            keep=keep,
        )
    return run_search(
        fit,
        terms,
        level=asked.level,
        surrogates=asked.surrogates,
        generator=generator,
        settings=asked.settings,
        parts=parts and not asked.quick,
        quick=asked.quick,
        keep=keep,
    )


def _screening_p_value(search: StepwiseSearch, asked: SearchOptions) -> bool:
    """Whether what is beside the last finding is far from anything that could count."""
    return _beside(search, asked) > max(asked.settings.confirmation.quiet, asked.level)


def _beside(search: StepwiseSearch, asked: SearchOptions) -> float:
    """The p-value of a first look beside the last finding."""
    last, settings = search.found[-1], asked.settings
    near = _near(last.fit, settings)
    others = [all(not _same(term, one.term, near, settings) for one in search.found) for term in last.scene.terms]
    generator = torch.Generator().manual_seed(asked.seed)
    return p_value_beside(last, others, settings.confirmation.glance, generator, quick=asked.quick)


def _evidence(fit: FittedModel, blocks: HeldOutBlocks, asked: SearchOptions) -> Evidence:
    """Of a fit on blocks that it has not seen; on all samples where nobody asks those."""
    return held_out(fit, blocks) if asked.judged else on_all(fit)


def _more_beside(search: StepwiseSearch, asked: SearchOptions) -> bool:
    """Whether a first look beside all findings shows another one; its p-value is 0 where it cannot see any."""
    return not asked.quick and 0.0 < _beside(search, asked) <= asked.level


def _accept(
    search: StepwiseSearch,
    beside: FittedModel,
    located: SearchResult,
    asked: SearchOptions,
    after: Evidence | None = None,
) -> StepwiseSearch:
    """With what was located beside a fit, if it counts; ``after`` is its evidence, where that is not the fit's own."""
    over = replace(search, left=())
    if located.p_value > asked.level or asked.max_findings == 0:
        return over
    before = search.evidence[-1]
    if after is None:
        after = _evidence(located.fit, search.blocks, asked)

    def holds(fit: FittedModel, evidence: Evidence) -> bool:
        one = replace(located, fit=fit)
        return _holds(
            one, before, evidence, search.blocks, asked.seed, asked.settings.confirmation, first=not search.found
        )

    same = None if located.with_noise else _under_the_same(beside, located.fit)
    paired = (
        after
        if same is None
        else _better_supported(before, (held_out(same, search.blocks), after), search.blocks, asked.seed)
    )
    if within_a_sample(located.term, located.fit.model.prepared) or not holds(located.fit, paired):
        return replace(over, unconfirmed=located)
    if len(search.found) == asked.max_findings:
        return replace(over, cut=True)
    fit, simpler = located.fit, after
    if located.with_noise:
        fit = simpler_by_price(located.fit, asked.declared, asked.settings)
        simpler = after if fit is located.fit else _evidence(fit, search.blocks, asked)
    else:
        fit, simpler = simplified(located.fit, after, search.blocks, holds, asked.settings.naming)
    paired = simpler if same is None or fit is not located.fit else paired
    after = simpler
    found = (*search.found, replace(located, fit=fit))
    near = _near(located.fit, asked.settings)
    left = tuple(t for t in search.left if not _same(t, located.term, near, asked.settings))
    pairs = (*search.pairs, (before, paired))
    taken = replace(search, found=found, evidence=(*search.evidence, after), pairs=pairs, left=left)
    if located.with_noise:
        taken = _eliminated(taken, asked)
    found = taken.found
    full = len(found) == asked.max_findings and not _more_beside(taken, asked)
    return replace(taken, left=()) if full else taken


def _in_two_steps(
    before: StepwiseSearch, after: StepwiseSearch, asked: SearchOptions, generator: torch.Generator
) -> StepwiseSearch:
    """The last finding as a simpler physics with another one beside it, where the two are as good.

    A form with more numbers can stand for two effects: friction that falls with speed for dry friction and drag.

    Args:
        before: without the last finding.
        after: with it.
        asked: of the diagnosis.
        generator: of draws.
    """
    settings = asked.settings
    if asked.quick or len(after.found) != len(before.found) + 1 or not after.left or not after.found[-1].with_noise:
        return after
    last = after.found[-1]
    simpler = last.term.effect.reduces_to
    near = [fit for fit in last.compared if simpler is not None and fit.model.terms[-1].effect.id == simpler.id]
    if not near:
        return after
    simple = max(near, key=lambda fit: priced(fit, settings))
    try:
        further = _located(simple, after.left, asked, generator, parts=False)
    except NoFitError:
        return after
    if further.p_value > asked.level or _score(further.fit, settings) < _score(last.fit, settings):
        return after
    first = replace(last, fit=simple, term=simple.model.terms[-1])
    evidence = held_out(simple, before.blocks)
    step = replace(
        after,
        found=(*before.found, first),
        evidence=(*before.evidence, evidence),
        pairs=(*before.pairs, (before.evidence[-1], evidence)),
    )
    both = _accept(step, simple, further, asked)
    return both if len(both.found) > len(after.found) else after


def _score(fit: FittedModel, settings: Settings) -> float:
    """Log-likelihood less the price of the noise and, by Schwarz, of the numbers of effects and their shapes."""
    numbers = fit.model.size + sum(len(term.effect.fitted_shape) for term in fit.model.terms)
    return priced(fit, settings) - 0.5 * math.log(len(fit.residual)) * numbers


def _eliminated(search: StepwiseSearch, asked: SearchOptions) -> StepwiseSearch:
    """Without findings whose effect the others have taken over; what is left is one model, fitted anew."""
    declared, settings = asked.declared, asked.settings
    while len(search.found) > 1:
        final = search.found[-1].fit
        number = needless_term(final, declared, settings)
        fit = None if number is None else without(final, number, declared, settings)
        if number is None or fit is None:
            break
        kept = [one for place, one in enumerate(search.found) if place != number]
        fits = [fit]
        while len(fits[0].model.terms) > 1:
            less = without(fits[0], len(fits[0].model.terms) - 1, declared, settings)
            if less is None:
                return search
            fits.insert(0, less)
        found = tuple(replace(one, fit=each, term=each.model.terms[-1]) for one, each in zip(kept, fits, strict=True))
        evidence = (search.evidence[0], *(held_out(each, search.blocks) for each in fits))
        search = replace(search, found=found, evidence=evidence, pairs=tuple(itertools.pairwise(evidence)))
    return search


def _better_supported(before: Evidence, ways: Sequence[Evidence], blocks: HeldOutBlocks, seed: int) -> Evidence:
    """A finding under the pushes of the model without it, or under those that it leaves, whichever shows more surely.

    Under the first, what the finding does was taken for pushes as far as may be; under the others, few samples can
    outweigh all.
    """

    def least(after: Evidence) -> float:
        difference = after.log_likelihood - before.log_likelihood
        return gain_interval(difference, blocks.block, torch.Generator().manual_seed(seed))[1][0]

    return max(ways, key=least)


def _under_the_same(beside: FittedModel, fit: FittedModel) -> FittedModel | None:
    """A fit with a finding under the pushes of the one without it, for the two to be compared; None where it is so."""
    if not with_noise_of_fit(beside) or fit.model.prepared is beside.model.prepared:
        return None
    model = JointModel(beside.model.prepared, fit.model.terms, beside.model.near)
    try:
        return fitted(model, fit.parameters, beside.bound, graduate=False)
    except NoFitError:
        return None


def _near(fit: FittedModel, settings: Settings) -> float:
    """Seconds within which a step is the same one."""
    time = fit.model.prepared.time
    return settings.confirmation.near * float(time[-1] - time[0])


def _same(term: Term, found: Term, near: float, settings: Settings) -> bool:
    """Whether a candidate is the found effect again, or a curve over its driver.

    A step further away than ``near``, in s, is another one; closer by, it would only mend how the first one rises.
    """
    if "onset" in term.shape and "onset" in found.shape:
        return abs(term.shape["onset"] - found.shape["onset"]) < near
    if term.key == found.key or (term.effect.is_curve and term.columns == found.columns):
        return True
    # beside a driver that was found, a column that goes the same way would only share its amplitude
    if term.driver is None or found.driver is None:
        return False
    return alike(term.driver, found.driver) > settings.naming.alike_columns
