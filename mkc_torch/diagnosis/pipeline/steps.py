"""The state of a stepwise search, and backward elimination of findings that the other findings make needless."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from mkc_torch.diagnosis.decisions import ScoredModel
from mkc_torch.diagnosis.evidence.held_out import Evidence, HeldOutBlocks, held_out
from mkc_torch.diagnosis.model.fit import FittedModel, without_term
from mkc_torch.diagnosis.model.process_noise import fit_with_process_noise, refit_open_loop
from mkc_torch.diagnosis.model.term import Term, run_parallel
from mkc_torch.diagnosis.pipeline.prepare import SearchOptions
from mkc_torch.diagnosis.search.own_noise import (
    free_runs,
    needless_terms,
    number_count,
    priced,
    without,
)
from mkc_torch.diagnosis.search.ranking import improves_open_loop
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.nonlinear import NoFitError


@dataclass(frozen=True)
class StepwiseSearch:
    """The stepwise search so far.

    Attributes:
        first: result of the first search.
        found: the findings.
        unconfirmed: the last candidate that held-out blocks did not confirm.
        blocks: the held-out blocks.
        evidence: of the simulation without findings, and after each finding.
        left: candidates that remain to be searched; empty once the search is over.
        pairs: evidence without and with each finding under the same process noise, by which it was confirmed.
        refused: candidates that passed the surrogates, but enlarge the open-loop residual or are hardly visible.
        given_up: why the next search failed; empty if it did not.
        cut: whether there was a further finding beyond the limit.
        models: the models that were scored, in their order.
        column: the column whose other sign or unit explains more than any effect, in a sentence; empty if none does.
    """

    first: SearchResult | None
    found: tuple[SearchResult, ...]
    unconfirmed: SearchResult | None
    blocks: HeldOutBlocks
    evidence: tuple[Evidence, ...]
    left: tuple[Term, ...]
    pairs: tuple[tuple[Evidence, Evidence], ...] = ()
    refused: tuple[SearchResult, ...] = ()
    given_up: str = ""
    cut: bool = False
    models: tuple[ScoredModel, ...] = ()
    column: str = ""

    @property
    def parts(self) -> tuple[object, ...]:
        """Everything that the next search needs."""
        fits = [located.fit for located in self.found]
        pairs = [evidence for pair in self.pairs for evidence in pair]
        return self.first, *self.found, *fits, *(fit.model for fit in fits), self.blocks, *self.evidence, *pairs


def eliminated(search: StepwiseSearch, options: SearchOptions) -> StepwiseSearch:
    """Remove findings, one or two at a time, that the others make needless, and refit the remaining model.

    A finding that clearly improves the open loop stays, even if process noise with another finding replaces it one step
    ahead.
    """
    while len(search.found) > 1:
        final = search.found[-1].fit
        numbers = needless_terms(final, options.declared, options.settings)
        fit = without(final, numbers, options.declared, options.settings) if numbers else None
        if fit is None or improves_open_loop(final, fit):
            break
        kept = [finding for number, finding in enumerate(search.found) if number not in numbers]
        less = with_fit(search, kept, fit, options)
        if less is None:
            break
        search = less
    return search


def exchanged(search: StepwiseSearch, further: SearchResult, options: SearchOptions) -> StepwiseSearch | None:
    """Replace a finding by a further one beyond their limit; None if that is not clearly more likely.

    An effect that stands for a part of another, such as a limit for play, is found first if the other shows only once
    later findings are in the model.
    """
    known = [without(further.fit, (number,), options.declared, options.settings) for number in range(len(search.found))]
    fits = {number: fit for number, fit in enumerate(known) if fit is not None}
    if not fits:
        return None
    least = max(fits, key=lambda number: priced(fits[number], options.settings))
    price = 0.5 * math.log(len(further.fit.residual)) * (number_count(fits[least]) - number_count(further.fit, least))
    gain = priced(fits[least], options.settings) - priced(search.found[-1].fit, options.settings) - price
    if gain < options.settings.naming.separable:
        return None
    kept = (*(finding for number, finding in enumerate(search.found) if number != least), further)
    left = tuple(term for term in search.left if term.key != further.term.key)
    return with_fit(replace(search, left=left), kept, fits[least], options)


def revised(search: StepwiseSearch, options: SearchOptions) -> StepwiseSearch:
    """Replace earlier findings by rivals of their searches that are clearly more likely with the other findings.

    An earlier finding was chosen while the later ones were missing, and may stand for a part of them.
    """
    if options.quick or not all(finding.with_noise for finding in search.found):
        return search
    for finding in search.found[:-1]:
        search = _with_better_rival(search, finding, options) or search
    return search


def _with_better_rival(search: StepwiseSearch, finding: SearchResult, options: SearchOptions) -> StepwiseSearch | None:
    """Replace a finding by its most likely rival; None if that is not clearly more likely.

    All start from the open loop: a fit under the remaining noise would keep to the finding's parameters. The rival has
    to gain twice the limit of separability, because the finding has passed a search of its own.
    """
    final, settings = search.found[-1].fit, options.settings
    number = next(n for n, known in enumerate(search.found) if known.term.key == finding.term.key)
    again = None if final.open_loop is None else _under_own_noise(final.open_loop, options)
    least = max(_score(fit, number, settings) for fit in (final, again) if fit is not None)
    free = refit_open_loop(without_term(final, number))
    keys = {known.term.key for known in search.found}
    terms = [term for term in finding.scene.terms if term.key not in keys]
    if free is None or not terms:
        return None
    works = [partial(_under_own_noise, run, options) for _, run in free_runs(free, terms, settings).fits]
    fits = [fit for fit in run_parallel(works, free.model.prepared, terms) if fit is not None]
    best = max(fits, key=lambda fit: _score(fit, -1, settings), default=None)
    if best is None or _score(best, -1, settings) < least + 2.0 * settings.naming.separable:
        return None
    kept = tuple(known for n, known in enumerate(search.found) if n != number)
    return with_fit(search, (*kept, replace(finding, term=best.model.terms[-1])), best, options)


def _under_own_noise(run: FittedModel, options: SearchOptions) -> FittedModel | None:
    """Return an open-loop fit again under the noise that remains; None if that has no finite result."""
    try:
        return fit_with_process_noise(run, options.declared, options.settings.noise).fit
    except NoFitError:
        return None


def _score(fit: FittedModel, number: int, settings: Settings) -> float:
    """Log-likelihood less the penalty of the noise, and Schwarz's penalty of one effect."""
    return priced(fit, settings) - 0.5 * math.log(len(fit.residual)) * number_count(fit, number)


def with_fit(
    search: StepwiseSearch, findings: Sequence[SearchResult], fit: FittedModel, options: SearchOptions
) -> StepwiseSearch | None:
    """Return the search with other findings, estimated together; None if a fit with a part of them fails.

    Args:
        search: the search.
        findings: the findings.
        fit: with all of them, in this order.
        options: of the diagnosis.
    """
    fits = [fit] if findings else []
    while len(fits) < len(findings):
        less = without(fits[0], (len(fits[0].model.terms) - 1,), options.declared, options.settings)
        if less is None:
            return None
        fits.insert(0, less)
    found = tuple(replace(old, fit=new, term=new.model.terms[-1]) for old, new in zip(findings, fits, strict=True))
    evidence = (search.evidence[0], *(held_out(each, search.blocks) for each in fits))
    left = search.left if found else ()
    return replace(search, found=found, evidence=evidence, pairs=tuple(itertools.pairwise(evidence)), left=left)
