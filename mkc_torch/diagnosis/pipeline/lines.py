"""Periodic disturbances: the line of a residual as candidates, and as a finding of simulations without states."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mkc_torch.diagnosis.evidence.held_out import held_out, on_all
from mkc_torch.diagnosis.model.fit import FittedModel, fitted_with_effect
from mkc_torch.diagnosis.model.shapes import ports_of, shape_fitted
from mkc_torch.diagnosis.model.term import Driver, Key, Term
from mkc_torch.diagnosis.pipeline.prepare import SearchOptions
from mkc_torch.diagnosis.pipeline.steps import StepwiseSearch
from mkc_torch.diagnosis.pipeline.stepwise import Keep, accept, first_step, search_before
from mkc_torch.diagnosis.search.lines import line_of
from mkc_torch.diagnosis.search.moves import linear_gains
from mkc_torch.diagnosis.search.problem import SearchProblem
from mkc_torch.diagnosis.search.ranking import Ranked
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.diagnosis.search.tangents import tangents_of
from mkc_torch.effects.base import Effect
from mkc_torch.nonlinear import NoFitError
from mkc_torch.simulation.protocol import PreparedSimulation

_SHARE = 0.2
"""Share of the level that a line is tested at, next to the test of all other effects: of both, at most 1.2 times the
level alarm falsely (weights of Genovese, Roeder & Wasserman, Biometrika 93 (2006), 509)."""


@dataclass(frozen=True)
class PeriodicCandidates:
    """The places at which a disturbance with the period of a residual's line can act.

    Attributes:
        terms: a candidate for each place, with the line's period.
        p_value: of the line, over the share of the level that it is tested at.
        resolution: of the recording in Hz, the reciprocal of its length.
    """

    terms: tuple[Term, ...]
    p_value: float
    resolution: float

    def p_of(self, term: Term) -> float:
        """Return the p-value of a periodic effect: that of the line if the effect's frequency is the line's, else 1."""
        near = [1.0 / own.shape["period"] for own in self.terms if own.key == term.key]
        same = bool(near) and abs(near[0] - 1.0 / term.shape["period"]) < self.resolution
        return self.p_value if same else 1.0


Lines = Callable[[FittedModel], PeriodicCandidates | None]
"""A search for the line of a fit's residual; None where no line is possible."""


def line_candidates(
    fit: FittedModel, drivers: Sequence[Driver], effects: Sequence[Effect], options: SearchOptions
) -> PeriodicCandidates | None:
    """Return the candidates for the line of a fit's residual; None without a possible line.

    Args:
        fit: in open loop if possible.
        drivers: recorded columns, whose own lines are left out.
        effects: the catalogue; its effects ``by_periodogram`` are the candidates.
        options: of the diagnosis.
    """
    prepared = fit.model.prepared
    places = [
        (effect, port) for effect in effects if effect.by_periodogram for port in ports_of(effect, prepared.ports)
    ]
    if not places or options.too_few:
        return None
    values, counts = fit.pseudo(options.settings.noise)
    line = line_of(
        prepared.time,
        values,
        counts,
        tangents_of(fit.model, fit.parameters, options.settings.noise).nuisance,
        prepared.measured - fit.residual,
        _signals(prepared, drivers),
        draws=0 if options.quick else options.surrogates,
        generator=torch.Generator().manual_seed(options.seed),
    )
    if line is None:
        return None
    shape = {"period": 1.0 / line.frequency, "start": float(prepared.time.min())}
    channel = prepared.channels[line.channel]
    have = {term.key for term in fit.model.terms}
    terms = [Term(effect, None, shape, "" if port == effect.port else port) for effect, port in places]
    # an output without a state has the line itself; a state's disturbance can show in any output
    terms = [
        term
        for term in terms
        if term.key not in have and (prepared.dynamics is not None or channel in prepared.ports[term.port].channels)
    ]
    resolution = 1.0 / float(prepared.time.max() - prepared.time.min())
    p_value = min(line.p_value / _SHARE, 1.0)
    return PeriodicCandidates(tuple(terms), p_value, resolution) if terms else None


def _signals(prepared: PreparedSimulation, drivers: Sequence[Driver]) -> list[Tensor]:
    """Return the inputs and the recorded drivers."""
    inputs = [name.removeprefix("input ") for name, port in prepared.ports.items() if port.kind == "input"]
    recorded = [prepared.recording[name] for name in inputs if name in prepared.recording]
    return [*recorded, *(column for driver in drivers for column in driver.values.unbind(-1))]


def with_line(located: SearchResult, line: PeriodicCandidates, near: FittedModel) -> SearchResult:
    """Return a search result with the candidates of a line, which lead its ranking if the line is more significant.

    Args:
        located: result of the search of all other candidates.
        line: the candidates.
        near: the fit in whose residual the line is.
    """
    first = len(located.scene.terms)
    gains, _ = linear_gains(near, line.terms, located.scene.settings.noise)
    more = [Ranked(first + k, gain, max(gains) - gain) for k, gain in enumerate(gains) if math.isfinite(gain)]
    more.sort(key=lambda rival: rival.gap)
    ranking = (*more, *located.ranking) if line.p_value < located.p_value else (*located.ranking, *more)
    p_value = min(located.p_value, line.p_value)
    return replace(located, look=located.look.with_more(line.terms), ranking=ranking, p_value=p_value)


def first_line_step(
    base: FittedModel,
    terms: tuple[Term, ...],
    options: SearchOptions,
    generator: torch.Generator,
    keep: Keep,
    lines: Lines,
) -> StepwiseSearch:
    """Run the first search of a simulation without states: for a line, and without one for all other candidates.

    Args:
        base: the simulation without findings.
        terms: the other candidates.
        options: of the diagnosis.
        generator: of the surrogates.
        keep: receives the search so far.
        lines: the search for a line.
    """
    line = lines(base) if options.max_findings else None
    if line is not None and line.p_value <= options.level:
        search = search_before(base, terms, options)
        search = replace(search, evidence=(held_out(base, search.blocks) if options.judged else on_all(base),))
        taken = line_step(search, base, lines, options)
        if taken.found:
            keep(taken)
            return taken
    return first_step(base, terms, options, generator, keep)


def line_step(search: StepwiseSearch, fit: FittedModel, lines: Lines, options: SearchOptions) -> StepwiseSearch:
    """Add the line of a fit's residual to the findings of a simulation without states, if it is one.

    Args:
        search: the search so far, with the fit's evidence.
        fit: with the findings so far.
        lines: the search for a line.
        options: of the diagnosis.

    Returns:
        The search with the finding and the candidates that are left; the same search without one.
    """
    line = lines(fit)
    if line is None or line.p_value > options.level:
        return search
    try:
        located = _located(fit, line, search.left, options)
        taken = accept(search, fit, located, options)
    except NoFitError:
        return search
    if len(taken.found) == len(search.found):
        return search
    return taken if search.found else replace(taken, first=located)


def _located(fit: FittedModel, line: PeriodicCandidates, terms: Sequence[Term], options: SearchOptions) -> SearchResult:
    """Return the search result of a line, its rivals behind it by their linear gains."""
    settings = options.settings
    both = (*terms, line.terms[0])
    gains, sizes = linear_gains(fit, both, settings.noise)
    model = fit.model.with_term(both[-1])
    best = shape_fitted(fitted_with_effect(fit, model, torch.cat([fit.parameters, sizes[-1]]), graduate=False))
    values, counts = fit.pseudo(settings.noise)
    look = SearchProblem(
        fit, fit, both, tangents_of(fit.model, fit.parameters, settings.noise, both), values, counts, settings
    ).under()
    rivals: dict[Key, Ranked] = {}
    for number in sorted(range(len(both)), key=lambda n: -gains[n]):
        if math.isfinite(gains[number]):
            gap = max(gains[-1] - gains[number], 0.0)
            rivals.setdefault(both[number].key, Ranked(number, gains[number], gap))
    own = rivals.pop(both[-1].key, Ranked(len(both) - 1, gains[-1], 0.0))
    return SearchResult(
        best.model.terms[-1],
        best,
        line.p_value,
        0.0,
        (own, *rivals.values()),
        look.noise,
        look,
        look.linearised,
    )
