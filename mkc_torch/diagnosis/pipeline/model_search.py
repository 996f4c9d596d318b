"""The search over models of differential equations: screening, beam by score, and a p-value for each effect."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch

from mkc_torch.diagnosis.environment import GoodnessOfFit
from mkc_torch.diagnosis.evidence.held_out import Evidence, blocks_of, gain_interval, held_out, on_all
from mkc_torch.diagnosis.goodness_of_fit import goodness_of_fit, poor_fits, size_of
from mkc_torch.diagnosis.model.fit import FittedModel, fitted_like
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.process_noise import (
    ProcessNoiseFit,
    first_samples,
    fit_with_process_noise,
    has_process_noise,
    with_noise_around,
)
from mkc_torch.diagnosis.model.shapes import described, shape_fitted
from mkc_torch.diagnosis.model.term import Key, Term
from mkc_torch.diagnosis.noise.spectrum import correlation_time
from mkc_torch.diagnosis.optional import optional
from mkc_torch.diagnosis.pipeline.chains import (
    chain_of_line,
    chain_to,
    chains_to_test,
    other_ways,
    without_replaced_curves,
)
from mkc_torch.diagnosis.pipeline.lines import Lines, PeriodicCandidates, with_line
from mkc_torch.diagnosis.pipeline.prepare import SearchOptions
from mkc_torch.diagnosis.pipeline.steps import StepwiseSearch
from mkc_torch.diagnosis.pipeline.suspected import suspected_models
from mkc_torch.diagnosis.pipeline.trail import trail_of
from mkc_torch.diagnosis.score import basis_of, score, separation
from mkc_torch.diagnosis.search.at_given_values import instead_of_numbers
from mkc_torch.diagnosis.search.beam import BeamSearch
from mkc_torch.diagnosis.search.candidate import Candidate
from mkc_torch.diagnosis.search.columns import best_change
from mkc_torch.diagnosis.search.in_words import terms_in_words
from mkc_torch.diagnosis.search.moves import comes_by_exchange, with_wide_grid
from mkc_torch.diagnosis.search.ranking import Ranked
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.diagnosis.search.screening import screened
from mkc_torch.diagnosis.thresholds import FAR_LESS, KEPT
from mkc_torch.nonlinear import NoFitError

Keep = Callable[[StepwiseSearch], object]
"""A callback that receives the search so far, in case it is stopped."""

_QUICK_MODELS = 8
"""Largest number of models in a quick look."""


def search_models(
    base: ProcessNoiseFit,
    terms: tuple[Term, ...],
    options: SearchOptions,
    generator: torch.Generator,
    keep: Keep,
    lines: Lines = lambda _: None,
    progress: Callable[[str], object] = lambda _: None,
) -> StepwiseSearch:
    """Screen the candidates; if the strongest is significant, search the best set of effects and test each of them.

    Args:
        base: the fit without effects.
        terms: candidates.
        options: of the diagnosis.
        generator: of the surrogates.
        keep: receives the search so far.
        lines: the search for a line in a residual, whose candidates are searched with the others.
        progress: called with the name of each stage.

    Raises:
        NoFitError: the fit's trajectory is lost.
    """
    fit, settings = base.fit, options.settings
    correlation = max(correlation_time(series) for series in fit.pseudo(settings.noise)[0].unbind(1))
    blocks = blocks_of(
        len(fit.residual), math.ceil(correlation), settings.confirmation, first_samples(fit.model.prepared)
    )
    search = StepwiseSearch(None, (), None, blocks, (), terms)
    ground = fit if base.free is None else base.free
    keep(search)
    if not terms:
        return replace(search, evidence=(_evidence(search, ground, options),), left=())
    first = _screened(fit, terms, options, generator)
    others, line = first.p_value, lines(ground)
    if line is not None and line.p_value <= options.level:
        terms, first = (*terms, *line.terms), with_line(first, line, ground)
    keep(replace(search, first=first))
    search = replace(search, first=first, evidence=(_evidence(search, ground, options),))
    keep(search)
    if options.max_findings == 0 and not options.suspect:
        return replace(search, left=())
    progress("comparing models")
    beam = _beam(base, first, terms, options)
    suspected = suspected_models(options.suspect, beam, _start(base), settings.noise, quick=options.quick)
    search = replace(search, models=(*trail_of(beam, None), *suspected))
    keep(search)
    if options.max_findings == 0:
        return replace(search, left=())
    column = _wrong_column(beam, base, options)
    if column:
        return replace(search, left=(), column=column)
    if first.p_value > options.level:
        follow = _follow(beam) if not options.quick else ()
        found = replace(search, left=(), first=replace(first, follow=follow))
    else:
        progress("testing the effects of the best models")
        p_values = _PValues(others, line, lines)
        tested = partial(
            _tested, search, p_values=p_values, beam=beam, base=base, options=options, generator=generator, keep=keep
        )
        chains = [
            chain
            for chain in [*chains_to_test(beam), *chain_of_line(beam)]
            if others <= options.level or chain[0].fit.model.terms[0].effect.by_periodogram
        ]
        found = _first_confirmed(chains, search, beam, tested)
    final = found.found[-1].fit if found.found else _start(base)
    step = "comparing with the values given"
    progress(step)
    return replace(found, instead=optional(step, partial(_instead, final, beam), lambda: ""))


def _first_confirmed(
    chains: Sequence[Sequence[Candidate]],
    search: StepwiseSearch,
    beam: BeamSearch,
    tested: Callable[[Sequence[Candidate]], StepwiseSearch],
) -> StepwiseSearch:
    """Test chains of models one after the other until held-out blocks confirm an effect or nothing is significant."""
    for chain in chains:
        found = _in_either_way(chain, beam, tested)
        # the simpler model counts as a rival only if all its effects are significant
        if 0 < len(found.found) < len(chain) and beam.best.key != chain[-1].key:
            again = _in_either_way(chain_to(beam.best, beam), beam, tested)
            found = again if len(again.found) > len(found.found) else found
        if found.found or not found.unconfirmed:
            return found
        search = replace(search, unconfirmed=search.unconfirmed or found.unconfirmed)
    return replace(search, left=())


def _in_either_way(
    chain: Sequence[Candidate], beam: BeamSearch, tested: Callable[[Sequence[Candidate]], StepwiseSearch]
) -> StepwiseSearch:
    """Test a chain of models, and if an effect is not significant another chain; return the longer result."""
    found = tested(chain)
    for other in other_ways(chain, len(found.found), beam):
        again = tested(other)
        found = again if len(again.found) > len(found.found) else found
    return found


def _screened(
    fit: FittedModel, terms: tuple[Term, ...], options: SearchOptions, generator: torch.Generator
) -> SearchResult:
    return screened(
        fit,
        terms,
        level=options.level,
        surrogates=options.surrogates,
        generator=generator,
        declared=options.declared,
        settings=options.settings,
        quick=options.quick,
    )


def _start(base: ProcessNoiseFit) -> FittedModel:
    """Return the simulation alone, in open loop if that is found."""
    return base.fit if base.free is None else base.free


def _beam(base: ProcessNoiseFit, first: SearchResult, terms: tuple[Term, ...], options: SearchOptions) -> BeamSearch:
    """Search the models; without a significant candidate, only those with one effect.

    Where no finding is wanted, only the simulation alone is scored.
    """
    start = _start(base)
    basis = basis_of(base.fit, len({term.key for term in terms}), options.declared, options.settings)
    ranked = [term for term in (terms[rival.number] for rival in first.ranking) if not comes_by_exchange(term)]
    leaders = ranked[: options.settings.search.own_noise]
    beam = BeamSearch(terms, basis, options.settings, options.declared, fixed=options.fixed)
    beam.noisy = base.fit if has_process_noise(base.fit) and not options.quick else None
    significant = first.p_value <= options.level
    if options.quick:
        beam.most_models = _QUICK_MODELS
    beam.most_terms = min(beam.most_terms, options.max_findings) if significant else 1
    if options.max_findings == 0:
        beam.models[()] = Candidate(start, score(start, basis, options.settings), "")
        return beam
    beam.run(start, leaders if significant else ())
    return beam


def _wrong_column(beam: BeamSearch, base: ProcessNoiseFit, options: SearchOptions) -> str:
    """Return the column whose other sign or unit scores clearly higher than any effect, in a sentence; else empty."""
    if options.quick:
        return ""
    settings, fits = options.settings, [fit for fit in (base.free, base.fit) if fit is not None]
    poor = bool(poor_fits(_goodness(fits[0]), settings.evidence.followed))
    found = best_change(fits, beam.basis, settings, poor=poor)
    if found is None or poor_fits(_goodness(found.fit), settings.evidence.followed):
        return ""
    gain = (found.value - beam.best.value) / beam.basis.kappa
    if not gain > settings.naming.separable:
        return ""
    sizes = dict(zip(found.fit.model.prepared.channels, size_of(found.fit.residual).tolist(), strict=True))
    reached = ", ".join(f"{name} {size:.3g}" for name, size in sizes.items())
    return (
        f"With the {found.change.sentence} the simulation scores {gain:.0f} more than with any effect; the "
        f"open-loop residual is then {reached}."
    )


def _goodness(fit: FittedModel) -> tuple[GoodnessOfFit, ...]:
    return goodness_of_fit(fit.model.prepared, fit.residual, {})


@dataclass(frozen=True)
class _PValues:
    """The p-values of effects: of a periodic effect that of the line, of all others that of the screening.

    Attributes:
        others: of the screening at the simulation alone.
        line: at the simulation alone; None without a line.
        lines: the search for the line of another fit.
    """

    others: float
    line: PeriodicCandidates | None
    lines: Lines

    def of(self, own: Term, previous: FittedModel, located: SearchResult, number: int) -> float:
        """Return the p-value of an effect, the ``number``-th after the simulation alone, at the fit before it."""
        if not own.effect.by_periodogram:
            return located.p_value if number else self.others
        free = previous if previous.open_loop is None else previous.open_loop
        line = self.lines(free) if number else self.line
        return 1.0 if line is None else line.p_of(own)


def _tested(
    search: StepwiseSearch,
    chain: Sequence[Candidate],
    p_values: _PValues,
    beam: BeamSearch,
    base: ProcessNoiseFit,
    options: SearchOptions,
    generator: torch.Generator,
    keep: Keep,
) -> StepwiseSearch:
    """Add the effects of a chain of models one after the other as long as each is significant.

    The null of each is the model with the effects before it, and all candidates are screened again.
    """
    for number, step in enumerate(chain):
        previous = search.found[-1].fit if search.found else base.fit
        try:
            own = step.fit.model.terms[-1]
            located = search.first if number == 0 else _screened_with_line(previous, own, beam, options, generator)
            assert located is not None
            located = replace(located, p_value=p_values.of(own, previous, located, number))
            if located.p_value > options.level:
                break
            step = _final(step, beam, options, last=number == len(chain) - 1)
            located = _as_result(located, step, beam)
            after = _evidence(search, step.fit, options)
        except NoFitError as error:
            return replace(search, left=(), given_up=str(error))
        alike = (base.free is None) == (step.fit.open_loop is None)
        if number == 0 and options.judged and alike and _refused(search.evidence[0], after, search, options):
            return replace(search, unconfirmed=located)
        search = replace(search, found=(*search.found, located), evidence=(*search.evidence, after), left=())
        suspected = (model for model in search.models if model.suspected)
        search = replace(search, models=(*trail_of(beam, step.fit), *suspected))
        keep(search)
    return replace(search, left=())


def with_step_of(search: StepwiseSearch, base: ProcessNoiseFit, options: SearchOptions) -> StepwiseSearch:
    """Return the search with its findings fitted again at the step of integration of another fit without effects.

    The p-values are those of the search.

    Raises:
        NoFitError: a model loses the recording at that step.
    """
    prepared = base.fit.model.prepared.open_loop()
    ground = base.fit if base.free is None else base.free
    found, evidence = [], [_evidence(search, ground, options)]
    for located in search.found:
        # an effect may have chosen another hold of an input than the simulation alone
        holds = located.fit.model.prepared.input_hold
        model = JointModel(prepared.with_input_hold(holds), located.fit.model.terms)
        fit = fitted_like(model, located.fit.parameters, located.fit, graduate=True)
        fit = fit if fit.squares else shape_fitted(fit)
        if has_process_noise(located.fit):
            fit = fit_with_process_noise(fit, options.declared, options.settings.noise).fit
        found.append(replace(located, fit=fit, term=fit.model.terms[-1]))
        evidence.append(_evidence(search, fit, options))
    return replace(search, found=tuple(found), evidence=tuple(evidence))


def _screened_with_line(
    fit: FittedModel, own: Term, beam: BeamSearch, options: SearchOptions, generator: torch.Generator
) -> SearchResult:
    """Screen the candidates that a model lacks; a periodic effect is added to them without a test."""
    located = _screened(fit, _left(fit, beam), options, generator)
    if not own.effect.by_periodogram:
        return located
    return replace(located, look=located.look.with_more([own]))


def _left(fit: FittedModel, beam: BeamSearch) -> tuple[Term, ...]:
    """Return the candidates of the screening that a model lacks."""
    before = {term.family for term in fit.model.terms}
    return tuple(term for term in beam.terms if term.family not in before and not term.effect.by_periodogram)


def _final(step: Candidate, beam: BeamSearch, options: SearchOptions, *, last: bool) -> Candidate:
    """Return a model at its best shape, noise and, of the last, holds of the inputs, each by its score."""
    if options.quick:
        return step
    # tests of evidence need residuals that are white under the noise; a lag of a sensor is exact in open loop only
    gained = step.value - beam.models[()].value
    less = max(options.settings.naming.separable * beam.basis.kappa, KEPT * gained)
    whole = beam.simplified(beam.to_the_end(step))
    whole = beam.with_best_hold(whole) if last else whole
    noisy = beam.under_noise(whole, less)
    if noisy is not whole or has_process_noise(whole.fit):
        return noisy
    return replace(whole, fit=with_noise_around(whole.fit, options.declared, options.settings.noise))


def _as_result(located: SearchResult, step: Candidate, beam: BeamSearch) -> SearchResult:
    """Return the search result with the chosen effect first, and its rivals by their scores."""
    fit = step.fit
    own = fit.model.terms[-1]
    terms = located.scene.terms
    others = {term.key for term in fit.model.terms[:-1]}
    rivals: dict[Key, Candidate] = {}
    for model in without_replaced_curves(list(beam.models.values()), beam.models[()]):
        more = [term.key for term in model.fit.model.terms if term.key not in others]
        if len(model.fit.model.terms) == len(others) + 1 and len(more) == 1:
            known = rivals.get(more[0])
            rivals[more[0]] = model if known is None or model.value > known.value else known
    gaps = {key: separation(step.score, model.score, beam.basis) for key, model in rivals.items()}
    gaps[own.key] = 0.0
    last = max([gap for gap in gaps.values() if math.isfinite(gap)], default=0.0)
    ranking = []
    for rival in located.ranking:
        key = terms[rival.number].key
        gap = gaps.get(key, max(last, rival.gap))
        ranking.append(replace(rival, gap=gap if math.isfinite(gap) else max(last, rival.gap)))
    if own.key not in {terms[rival.number].key for rival in ranking}:
        number = next(number for number, term in enumerate(terms) if term.key == own.key)
        ranking.append(Ranked(number, max(fit.log_likelihood, 0.0), 0.0))
    ordered = tuple(sorted(ranking, key=lambda rival: (terms[rival.number].key != own.key, rival.gap)))
    compared = [model.fit for key, model in rivals.items() if model.fit.model.terms[-1].key == key]
    return replace(located, term=own, fit=fit, ranking=ordered, compared=compared)


def _evidence(search: StepwiseSearch, fit: FittedModel, options: SearchOptions) -> Evidence:
    """Evidence of a fit on held-out blocks, or on all samples if the blocks are not used; in open loop if possible.

    Innovations under process noise are smaller than the residual of an open loop, so the two do not compare.
    """
    free = fit if fit.open_loop is None else fit.open_loop
    return held_out(free, search.blocks) if options.judged else on_all(free)


def _refused(before: Evidence, after: Evidence, search: StepwiseSearch, options: SearchOptions) -> bool:
    """Whether held-out blocks are clearly less likely with the effect."""
    difference = after.log_likelihood - before.log_likelihood
    generator = torch.Generator().manual_seed(options.seed)
    return gain_interval(difference, search.blocks.block, generator)[1][1] < 0.0


def _instead(final: FittedModel, beam: BeamSearch) -> str:
    """Return the effects that take the place of unlikely numbers in sentences; empty if none do."""
    found = instead_of_numbers(beam, final, with_wide_grid(beam.terms, final.model.prepared.open_loop()))
    if found is None:
        return ""
    values = " and ".join(f"`{name}` at {value:.4g}" for name, value in found.values.items())
    effects = " and ".join(_with_shape(term) for term in found.model.fit.model.terms)
    sizes = size_of(found.model.fit.residual).tolist(), size_of(_free(final).residual).tolist()
    names = final.model.prepared.channels
    reached = ", ".join(
        f"{name} {held:.3g} instead of {free:.3g}" for name, held, free in zip(names, *sizes, strict=True)
    )
    own = beam.value_of(_free(final))
    gap = (own - found.model.value) / beam.basis.kappa
    compared = f"{gap:.0f} nats less" if gap > 0.0 else f"{-gap:.0f} nats more"
    given = "the value given" if len(found.values) == 1 else "the values given"
    return (
        f"With {values}, {given}, the search finds {effects}; the open-loop residual is then "
        f"{reached}, and the score is {compared}. Only a measurement of the number distinguishes the two."
    )


def _with_shape(term: Term) -> str:
    shape = described(term.effect, term.shape)
    return f"{terms_in_words([term])} ({shape})" if shape else terms_in_words([term])


def _free(fit: FittedModel) -> FittedModel:
    return fit if fit.open_loop is None else fit.open_loop


def _follow(beam: BeamSearch) -> tuple[FittedModel, ...]:
    """Return the open-loop fits with far smaller residuals than the simulation's, best first.

    General forms, such as a power law, are left out if there are others.
    """
    alone = beam.models[()]
    ranked = sorted(beam.models.values(), key=lambda model: -model.value)
    better = [model for model in ranked if model.fit.model.terms and model.value > alone.value]
    runs = [model.fit.open_loop for model in better if model.log_size - alone.log_size < math.log(FAR_LESS)]
    far = [run for run in runs if run is not None]
    named = [fit for fit in far if not fit.model.terms[-1].effect.is_generalisation]
    return tuple(named or far)
