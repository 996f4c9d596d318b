"""Chains of models, from one effect to the best set, along which each effect is tested."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.search.beam import BeamSearch
from mkc_torch.diagnosis.search.candidate import Candidate, in_order
from mkc_torch.diagnosis.search.moves import comes_by_exchange
from mkc_torch.diagnosis.thresholds import NAMED

_NEXT = 3
"""Models that are asked in turn if held-out blocks refuse the only effect of the best."""

_SAME_SCORE = 0.1
"""Nats within which the scores of two fits of the same physics are equal."""


def chains_to_test(beam: BeamSearch) -> list[list[Candidate]]:
    """Return chains of models to test: that of the simplest good model, and models with one effect.

    The simplest good model has the lowest price of those that this recording cannot separate from the highest score,
    and each of its effects raises the score: effects that only gain together have no null in which the first is missing
    alone. Of effects that were chosen together, only all together have to raise it. The screening has shown that an
    effect is missing, so the simulation alone is no rival of models with one effect: those that are more likely are
    tested if the first chain is refused.
    """
    alone = beam.models[()]
    least = -math.inf if alone.score is None else alone.score.log_likelihood
    usable = [
        model
        for model in beam.models.values()
        if model.fit.model.terms
        and model.score is not None
        and model.score.log_likelihood > least
        and not beam.enlarges(model)
    ]
    ranked = sorted(without_replaced_curves(usable, alone), key=lambda model: -model.value)
    single = [[model] for model in ranked if len(model.fit.model.terms) == 1]
    good = [model for model in ranked if model.value > alone.value]
    behind = beam.settings.naming.separable * beam.basis.kappa
    alike = [model for model in good if model.value >= good[0].value - behind]
    for model in [*_by_price(alike, beam.terms), *good[len(alike) :]]:
        chain = chain_to(model, beam)
        if _raises(chain, alone):
            return [chain, *[other for other in single if other[0].key != chain[0].key]][:_NEXT]
    return single[:_NEXT]


def _raises(chain: Sequence[Candidate], alone: Candidate) -> bool:
    """Whether each effect raises the score, or, of effects that were chosen together, all of them."""
    if chain[-1].together:
        return len(chain[0].fit.model.terms) == 1 and chain[-1].value > alone.value
    return all(later.value > earlier.value for earlier, later in itertools.pairwise([alone, *chain]))


def chain_of_line(beam: BeamSearch) -> list[list[Candidate]]:
    """Return the best model of a periodic effect alone as a chain."""
    alone = beam.models[()]
    single = [
        model
        for model in beam.models.values()
        if len(model.fit.model.terms) == 1
        and model.fit.model.terms[0].effect.by_periodogram
        and model.value > alone.value
        and not beam.enlarges(model)
    ]
    return [[max(single, key=lambda model: model.value)]] if single else []


def _by_price(models: Sequence[Candidate], terms: Sequence[Term]) -> list[Candidate]:
    """Order models by price, at equal price first those to first order in their columns, then by score.

    The same dependence on a column can have two names, as a loss and as the parameter of this loss; and a buoyancy
    whose surface is above the whole motion is a constant force. Of models of equal price and score with the same
    columns, that with the fewest shapes comes first, and then, if a column drives it, the name that is first in the
    catalogue.
    """

    def price(model: Candidate) -> tuple[float, int]:
        return round(model.price, 6), sum(comes_by_exchange(term) for term in model.fit.model.terms)

    def columns(model: Candidate) -> list[tuple[str, ...]]:
        return sorted(term.columns for term in model.fit.model.terms)

    def place(model: Candidate) -> tuple[int, list[int]]:
        own = {term.key for term in model.fit.model.terms} if any(columns(model)) else set()
        shapes = sum(len(term.shape) for term in model.fit.model.terms)
        return shapes, sorted(number for number, term in enumerate(terms) if term.key in own)

    ordered = sorted(models, key=price)
    for number, model in enumerate(ordered):
        same = [
            other
            for other in ordered[number:]
            if price(other) == price(model) and columns(other) == columns(model)
            if abs(other.value - model.value) < _SAME_SCORE
        ]
        if same:
            first = min(same, key=place)
            ordered.remove(first)
            ordered.insert(number, first)
    return ordered


def without_replaced_curves(models: Sequence[Candidate], alone: Candidate) -> list[Candidate]:
    """Return the models, without those whose curve follows hardly better than a model of named effects.

    A curve can follow any physics; it is the answer where no effect of the catalogue comes near.
    """
    curves = {model.key: any(term.effect.is_curve for term in model.fit.model.terms) for model in models}
    named = [model for model in models if not curves[model.key] and model.value > alone.value]

    def replaced(model: Candidate) -> bool:
        return any(
            len(other.fit.model.terms) <= len(model.fit.model.terms)
            and other.log_typical_size <= model.log_typical_size + math.log(NAMED)
            for other in named
        )

    return [model for model in models if not (curves[model.key] and replaced(model))]


def chain_to(model: Candidate, beam: BeamSearch) -> list[Candidate]:
    """Return models with 1, 2, … of a model's effects: the effect whose loss costs least score is the last."""
    chain = [model]
    while len(chain[0].fit.model.terms) > 1:
        less = beam.with_one_less(chain[0])
        if not less:
            break
        chain.insert(0, max(less, key=lambda candidate: candidate.value))
    return _in_orders_of(chain)


def _in_orders_of(chain: Sequence[Candidate]) -> list[Candidate]:
    """Return a chain with the effects of each model in the order in which they enter."""
    ordered = [chain[0]]
    for model in chain[1:]:
        before = ordered[-1]
        ordered.append(in_order(model, [*before.fit.model.terms, *missing_terms(model, before)]))
    return ordered


def other_ways(chain: Sequence[Candidate], reached: int, beam: BeamSearch) -> list[list[Candidate]]:
    """Return chains that end a step behind the effects that were found, and reach it through other effects.

    A linear screening may not see an effect while another is missing: a second vessel that fills only once the first
    overflows.
    """
    if not 0 < reached < len(chain):
        return []
    last = {term.key for term in missing_terms(chain[reached], chain[reached - 1])}
    ways = [less for less in beam.with_one_less(chain[reached]) if last & {term.key for term in less.fit.model.terms}]
    ways.sort(key=lambda model: -model.value)
    return [_in_orders_of([*chain_to(way, beam), chain[reached]]) for way in ways[:1]]


def missing_terms(model: Candidate, smaller: Candidate) -> list[Term]:
    known = {term.key for term in smaller.fit.model.terms}
    return [term for term in model.fit.model.terms if term.key not in known]
