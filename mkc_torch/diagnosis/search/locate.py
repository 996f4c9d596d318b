"""Locate and name: the strongest candidate beside a fit, how sure it is after the whole search, and its rivals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._parallel.fork import meanwhile
from mkc_torch.diagnosis.linearised.beside_wander import beside_wander
from mkc_torch.diagnosis.linearised.linearise import Linearised, linearise
from mkc_torch.diagnosis.linearised.tangents import Tangents, candidate_tangents, tangents_of
from mkc_torch.diagnosis.linearised.wander import NoiseFit
from mkc_torch.diagnosis.model.at_once import common_parts
from mkc_torch.diagnosis.model.fit import FittedModel, fitted_beside
from mkc_torch.diagnosis.model.shaped import shape_fitted
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.noise.colour import Colour
from mkc_torch.diagnosis.noise.pseudo_residual import REJECTED_BELOW
from mkc_torch.diagnosis.search.closing_in import closer, coloured, refined
from mkc_torch.diagnosis.search.one_stretch import telling_stretch
from mkc_torch.diagnosis.search.p_value import judged
from mkc_torch.diagnosis.search.preference import Preference
from mkc_torch.diagnosis.search.ranking import SEPARABLE, Ranked, own_p, possible_of, ranked
from mkc_torch.diagnosis.search.rivals import KEPT, by_joint_fits
from mkc_torch.diagnosis.search.strongest import refitted, strongest
from mkc_torch.nonlinear import NoFitError

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["Located", "locate"]

_DOUBTED = 25.0
"""Nats beyond all draws of noise up to which draws of other noise that is nearly as likely are asked too."""

_HIDDEN, _SMALLER = 0.01, 0.8
"""Share of the residuals that a fit without an effect may reject and one with it takes, and the scale with it over that
without, from which the former hides nothing of the effect."""


@dataclass(frozen=True)
class Located:
    """The outcome of a search.

    Attributes:
        term: the strongest candidate, at its best shape.
        fit: the joint refit with it.
        p_value: after the whole search, and no less than the candidate's own.
        beyond: nats by which it is rarer, by itself, than the strongest of the draws.
        ranking: for each candidate physics its best shape, gain in nats, and nats behind the first; best first.
        noise: the wander of the noise without the candidate.
        values, counts: (N, m), the pseudo-residual without the candidate, and what counts of it.
        linearised: the search that told candidates apart; ``tangents`` and ``terms`` are its candidates.
        stretch: samples without which there is nothing, first and the one after the last, if they are few.
        beside_nothing: the search that the p-value is from; ``linearised`` is another one where an effect was named.
    """

    term: Term
    fit: FittedModel
    p_value: float
    beyond: float
    ranking: tuple[Ranked, ...]
    noise: NoiseFit
    values: Float[Tensor, "N m"]
    counts: Float[Tensor, "N m"]
    linearised: Linearised
    tangents: Tangents
    terms: tuple[Term, ...]
    beside_nothing: Linearised
    stretch: tuple[int, int] | None = None


def locate(
    base: FittedModel,
    terms: Sequence[Term],
    *,
    level: float,
    surrogates: int,
    generator: torch.Generator,
    parts: bool = True,
) -> Located:
    """Search the candidates beside a fit.

    Args:
        base: the simulation with what was found so far.
        terms: candidates.
        level: below which p-value the candidate is named with care.
        surrogates: draws of noise that the strongest candidate is judged against, of each kind of noise.
        generator: of the draws.
        parts: also start from fits to parts of the recording, for where one model over all of it runs away.
    """
    terms = tuple(terms)
    prefer = Preference(terms, base.model.prepared)
    tried = len(terms)
    fits, tangents = strongest(base, terms, prefer, parts=parts)
    if _shows(base, fits[0]):
        around, best = base, fits[0]
        last = best.model.terms[-1]
        if last not in terms:
            terms, tangents = (*terms, last), _with_own(tangents, base, last)
    else:
        best, terms, tangents = _with_tangents(fits, terms)
        around = best
    parameters = around.parameters[: base.model.size]
    tangents = replace(tangents, nuisance=tangents.nuisance[..., : base.model.size])
    # without the effect, as what is left beside it weighs the samples
    left = beside_wander(best, base.model, parameters, tangents)
    counts, tangents = left.counts, replace(tangents, slow=left.slow)
    if around is base:
        added = best.residual - base.residual
    else:
        number, gamma = terms.index(best.model.terms[-1]), best.parameters[base.model.size :]
        added = torch.einsum("nmq,q->nm", tangents.candidates[number], gamma)
    pseudo = left.values - counts * added
    prepared = base.model.prepared
    colour = left.noise.colour
    naming = partial(_named, best, base, around, terms, tangents, pseudo, counts, colour, prefer, level)
    # a copy names it already, while this process asks whether there is anything to be named
    with meanwhile([naming], [base, best, *terms, *tangents.parts, *common_parts(prepared, terms)]) as answer:
        linearised = linearise(base.model, parameters, pseudo, counts, tangents)
        noise = linearised.search.noise_fit(linearised.series)
        found = linearised.search.gains(linearised.series.unsqueeze(-1))
        possible = possible_of(terms, linearised)
        p_value, beyond = judged(linearised, noise, found, possible[:tried], surrogates, generator)
        beside_nothing = linearised
        if p_value <= level and beyond < _DOUBTED:
            for colour in linearised.plausible():
                other = linearise(base.model, parameters, pseudo, counts, tangents, colour=colour)
                p_other, beyond_other = _judged(other, terms, tried, surrogates, generator)
                p_value, beyond = max(p_value, p_other), min(beyond, beyond_other)
        stretch = None
        if p_value <= level:
            own = int(torch.where(possible, found.log_p[:, 0], 0.0).argmin())
            trace = counts * (tangents.candidates[own] @ linearised.search.estimate(own, linearised.series)[0])
            stretch = telling_stretch(pseudo, counts, trace, tangents.nuisance)
        if stretch is not None:
            rest = _without(counts, stretch)
            beside = linearise(base.model, parameters, rest * pseudo, rest, tangents)
            others = _judged(beside, terms, tried, surrogates, generator)
            p_value, beyond = max(p_value, others[0]), min(beyond, others[1])
            beside_nothing = beside
        ranking = ranked(terms, found, prefer, possible)
        if p_value <= level:
            [named] = answer()
            best, ranking, linearised = named.fit, named.ranking, named.linearised
            terms, tangents = named.terms, named.tangents
            # it was another candidate that no draw came up to, if this one by itself is nothing out of the ordinary
            p_value = max(p_value, named.own_p)
    if p_value <= level:
        best, ranking = by_joint_fits(best, base, ranking, terms, linearised, tangents, prefer, fits)
        best = _settled(refined(best, base, again=True), base)
        best = coloured(best, base, around, tangents, counts, linearised)
        best = shape_fitted(best)
    return Located(
        best.model.terms[-1],
        best,
        p_value,
        beyond,
        ranking,
        noise,
        pseudo,
        counts,
        linearised,
        tangents,
        terms,
        beside_nothing,
        stretch if p_value > level else None,
    )


def _shows(base: FittedModel, fit: FittedModel) -> bool:
    """Whether a fit without an effect shows what there is of it: it rejects no more, and its scale is no larger.

    Then tangents there are the ones to judge it by. At a fit with it, an effect that is nearly not to be seen may have
    any size, as a step has while the sensor rests, and what is linear about that size says nothing about none. Where an
    effect bends a trajectory, tangents at the fit with it are the ones.
    """
    if fit.model.prepared.ports[fit.model.terms[-1].port].clock is not None:
        return False
    rejected = (base.weights < REJECTED_BELOW) & (fit.weights >= REJECTED_BELOW)
    return float(rejected.double().mean()) < _HIDDEN and bool((fit.d > _SMALLER * base.d).all())


def _with_own(tangents: Tangents, base: FittedModel, own: Term) -> Tangents:
    """The same with those of one candidate more."""
    more = candidate_tangents(base.model, base.parameters, [own], tangents.pointwise)
    return replace(tangents, candidates=(*tangents.candidates, *more))


def _without(counts: Float[Tensor, "N m"], stretch: tuple[int, int]) -> Float[Tensor, "N m"]:
    """With nothing that counts in a stretch."""
    rest = counts.clone()
    rest[slice(*stretch)] = 0.0
    return rest


def _judged(
    linearised: Linearised, terms: tuple[Term, ...], tried: int, surrogates: int, generator: torch.Generator
) -> tuple[float, float]:
    """As :func:`judged` says, of the strongest of the first candidates in a search."""
    noise = linearised.search.noise_fit(linearised.series)
    found = linearised.search.gains(linearised.series.unsqueeze(-1))
    possible = possible_of(terms, linearised)[:tried]
    return judged(linearised, noise, found, possible, surrogates, generator)


@dataclass(frozen=True)
class _Named:
    """What an effect is, if there is one: the fit with it, and the search that told it from others.

    ``own_p`` is the p-value of its candidate, as if it were the only one.
    """

    fit: FittedModel
    ranking: tuple[Ranked, ...]
    linearised: Linearised
    tangents: Tangents
    terms: tuple[Term, ...]
    own_p: float


def _named(
    best: FittedModel,
    base: FittedModel,
    around: FittedModel,
    terms: tuple[Term, ...],
    tangents: Tangents,
    pseudo: Float[Tensor, "N m"],
    counts: Float[Tensor, "N m"],
    colour: Colour,
    prefer: Preference,
    level: float,
) -> _Named:
    """Whether there is an effect is asked of the noise that has it in; which one it is, of the noise beside it."""
    linearised = linearise(base.model, around.parameters[: base.model.size], pseudo, counts, tangents, colour=colour)
    found = linearised.search.gains(linearised.series.unsqueeze(-1))
    close = ranked(terms, found, prefer, possible_of(terms, linearised))
    near = [terms[one.number] for one in close if one.gap < 2.0 * SEPARABLE]
    more = closer(near, around.model, around.parameters, tangents, counts, linearised)
    terms = (*terms, *more)
    beside = candidate_tangents(around.model, around.parameters, more, tangents.pointwise)
    tangents = replace(tangents, candidates=(*tangents.candidates, *beside))
    linearised = linearised.with_more(beside, counts)
    found = linearised.search.gains(linearised.series.unsqueeze(-1))
    ranking = ranked(terms, found, prefer, possible_of(terms, linearised))
    first, own = terms[ranking[0].number], best.model.terms[-1]
    bends = any(tangents.pointwise[term.port] is None for term in (first, own))
    if first.key != own.key or own_p(found, terms, best) > level:
        other = refitted(best, base, first, linearised, ranking[0].number)
        # the search is linear: where the joint fit loses much of the gain, it went too far; but where noise may wander,
        # what follows the wander gains most in joint fits, and the search knows better if it tells the two apart
        behind = [one.gap for one in ranking if terms[one.number].key == own.key]
        clear = tangents.slow is not None and not (behind and behind[0] < SEPARABLE)
        least = 0.0 if clear else KEPT * max(prefer.score(best, base), 0.0)
        gain = other.log_likelihood - base.log_likelihood if clear else prefer.score(other, base)
        kept = gain > least or (bends and prefer.by_innovations(best, other) > 0.0)
        if kept:
            best = other
    return _Named(best, ranking, linearised, tangents, terms, own_p(found, terms, best))


def _with_tangents(
    fits: Sequence[FittedModel], terms: tuple[Term, ...]
) -> tuple[FittedModel, tuple[Term, ...], Tangents]:
    """The first fit that has finite tangents, with them and their candidates, its own shape included."""
    for fit in fits:
        own = fit.model.terms[-1]
        tried = terms if own in terms else (*terms, own)
        try:
            return fit, tried, tangents_of(fit.model, fit.parameters, tried)
        except NoFitError:
            if fit is fits[-1]:
                raise
    raise AssertionError


def _settled(fit: FittedModel, base: FittedModel) -> FittedModel:
    """The fit; begun anew where it ran out of steps: they can wait for a scale that is still far too large."""
    if fit.converged:
        return fit
    again = fitted_beside(base, fit.model, fit.parameters, graduate=False)
    return again if again.log_likelihood > fit.log_likelihood else fit
