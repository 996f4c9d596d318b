"""Locate and name: the strongest candidate beside a fit, how sure it is after the whole search, and its rivals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._forked import meanwhile
from mkc_torch.diagnosis.candidates import finer
from mkc_torch.diagnosis.linearise import Linearised, Tangents, candidate_tangents, linearise, tangents_of
from mkc_torch.diagnosis.local import beside_wander
from mkc_torch.diagnosis.model import JointModel, Key, Term, one_sided
from mkc_torch.diagnosis.noise import Colour
from mkc_torch.diagnosis.own_colour import own_colour_gains
from mkc_torch.diagnosis.preference import Preference
from mkc_torch.diagnosis.refit import FittedModel, clipped_residual, fitted_beside
from mkc_torch.diagnosis.search import Gains, NoiseFit, log_survival
from mkc_torch.diagnosis.shape_fit import shape_fitted
from mkc_torch.diagnosis.side_by_side import fitted_each, known_of, learn, memory_kept, with_memory
from mkc_torch.effects.protocol import ContinuousEffect
from mkc_torch.functional import mkc_energy
from mkc_torch.order_statistic import robust_scale
from mkc_torch.simulation.protocol import Beginning

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["SEPARABLE", "Located", "Ranked", "locate"]

SEPARABLE = 4.5
"""Nats by which a rival must be less likely to count as told apart: three standard errors of what sets them apart."""

_SHORT_LIST = 6
_PARTS, _BETTER = 2, 0.8
_AWAY = 5.0
"""Times that a parameter is larger, or smaller, than where its fit began."""

_KEPT = 0.8
_ROUNDS = 3
_LEADING, _THIRD, _MUCH = 2, 0.6, 50.0
"""Fits whose shapes are tried; a third one, where it has this share of the first one's score and as many nats."""

_WANDERS = 2.0
"""Nats that a wander has to gain to be in the draws of noise."""

_SHAPES = 5


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
        linearised: the search that the p-value is from; ``tangents`` and ``terms`` are its candidates.
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


@dataclass(frozen=True)
class Ranked:
    """A candidate at its best shape: number in the list of candidates, gain in nats, and nats behind the first."""

    number: int
    gain: float
    gap: float


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
    fits = _strongest(base, terms, prefer, parts=parts)
    best, terms, tangents = _with_tangents(fits, terms)
    parameters = best.parameters[: base.model.size]
    tangents = replace(tangents, nuisance=tangents.nuisance[..., : base.model.size])
    number = terms.index(best.model.terms[-1])
    gamma = best.parameters[base.model.size :]
    # without the effect, as what is left beside it weighs the samples
    left = beside_wander(best, base.model, parameters, tangents)
    counts, tangents = left.counts, replace(tangents, slow=left.slow)
    pseudo = left.values - counts * torch.einsum("nmq,q->nm", tangents.candidates[number], gamma)
    prepared = base.model.prepared
    naming = with_memory(
        prepared, partial(_named, best, base, terms, tangents, pseudo, counts, left.noise.colour, prefer, level)
    )
    # a copy names it already, while this process asks whether there is anything to be named
    with meanwhile(naming, [base, best, *terms, *tangents.parts, *known_of(prepared, terms)]) as answer:
        linearised = linearise(base.model, parameters, pseudo, counts, tangents)
        noise = linearised.search.noise_fit(linearised.series)
        found = linearised.search.gains(linearised.series.unsqueeze(-1))
        possible = _possible(terms, linearised)
        p_value, beyond = _judged(linearised, noise, found, possible[:tried], surrogates, generator)
        ranking = _ranking(terms, found, prefer, possible)
        if p_value <= level:
            named, newest = (None if answer is None else answer()) or naming()
            learn(prepared, newest)
            best, ranking, linearised = named.fit, named.ranking, named.linearised
            terms, tangents = named.terms, named.tangents
            # it was another candidate that no draw came up to, if this one by itself is nothing out of the ordinary
            p_value = max(p_value, named.own_p)
    if p_value <= level:
        best, ranking = _by_joint_fits(best, base, ranking, terms, linearised, tangents, prefer, fits)
        best = _settled(_refined(best, base, again=True), base)
        shaped = shape_fitted(best)
        best = shaped if _repeats(shaped) else best
    return Located(
        best.model.terms[-1], best, p_value, beyond, ranking, noise, pseudo, counts, linearised, tangents, terms
    )


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
    terms: tuple[Term, ...],
    tangents: Tangents,
    pseudo: Float[Tensor, "N m"],
    counts: Float[Tensor, "N m"],
    colour: Colour,
    prefer: Preference,
    level: float,
) -> _Named:
    """Whether there is an effect is asked of the noise that has it in; which one it is, of the noise beside it."""
    linearised = linearise(base.model, best.parameters[: base.model.size], pseudo, counts, tangents, colour=colour)
    found = linearised.search.gains(linearised.series.unsqueeze(-1))
    close = _ranking(terms, found, prefer, _possible(terms, linearised))
    near = [terms[one.number] for one in close if one.gap < 2.0 * SEPARABLE]
    more = _closer(near, best.model, best.parameters, tangents, counts, linearised)
    terms = (*terms, *more)
    beside = candidate_tangents(best.model, best.parameters, more, tangents.pointwise)
    tangents = replace(tangents, candidates=(*tangents.candidates, *beside))
    linearised = linearised.with_more(beside, counts)
    found = linearised.search.gains(linearised.series.unsqueeze(-1))
    ranking = _ranking(terms, found, prefer, _possible(terms, linearised))
    first = terms[ranking[0].number]
    if first.key != best.model.terms[-1].key or _own_p(found, terms, best) > level:
        other = _refitted(best, base, first, linearised, ranking[0].number)
        # the search is linear: where the joint fit loses much of the gain, it went too far; but where noise may wander,
        # what follows the wander gains most in joint fits, and the search knows better if it tells the two apart
        behind = [one.gap for one in ranking if terms[one.number].key == best.model.terms[-1].key]
        clear = tangents.slow is not None and not (behind and behind[0] < SEPARABLE)
        least = 0.0 if clear else _KEPT * max(_score(best, base, prefer), 0.0)
        gain = other.log_likelihood - base.log_likelihood if clear else _score(other, base, prefer)
        if gain > least and _repeats(other):
            best = other
    best.model.residual(best.parameters)  # to be the newest that a simulation remembers
    return _Named(best, ranking, linearised, tangents, terms, _own_p(found, terms, best))


def _by_joint_fits(
    best: FittedModel,
    base: FittedModel,
    ranking: tuple[Ranked, ...],
    terms: tuple[Term, ...],
    linearised: Linearised,
    tangents: Tangents,
    prefer: Preference,
    known: Sequence[FittedModel],
) -> tuple[FittedModel, tuple[Ranked, ...]]:
    """The fit, or a simpler one that is no worse; and the ranking, with rivals that lose much of their gain put back.

    A port that is not pointwise bends the trajectory: a rival of the search can follow the one that the effect has
    made, and yet not make one like it. So those that the search has as near as the effect are fitted, unless a
    ``known`` fit keeps the gain.
    """
    own = best.model.terms[-1].key
    reach = SEPARABLE + max([one.gap for one in ranking if terms[one.number].key == own], default=0.0)
    near = [
        one
        for one in ranking
        if one.gap < reach and terms[one.number].key != own and tangents.pointwise[terms[one.number].port] is None
    ]
    won = _score(best, base, prefer)
    fitted = {fit.model.terms[-1].key: fit for fit in reversed(known) if _score(fit, base, prefer) >= _KEPT * won}
    new = [one for one in near if terms[one.number].key not in fitted]
    works = [partial(_tried, best, base, terms[one.number], linearised, one.number) for one in new]
    with memory_kept(base.model.prepared):
        for fit in fitted_each(best, works, [terms[one.number] for one in new]) if new else ():
            fitted[fit.model.terms[-1].key] = fit
    fits = [fitted[terms[one.number].key] for one in near]
    scores = [_score(fit, base, prefer) for fit in fits]
    behind = {one.number: won - score for one, score in zip(near, scores, strict=True) if score < _KEPT * won}
    told = sorted((replace(one, gap=max(one.gap, behind.get(one.number, 0.0))) for one in ranking), key=_gap)
    told = [replace(one, gap=one.gap - told[0].gap) for one in told]
    simpler = [
        (score, fit)
        for score, fit in zip(scores, fits, strict=True)
        if fit.model.sizes[-1] < best.model.sizes[-1] and score >= won and _repeats(fit)
    ]
    return max(simpler, key=lambda one: one[0])[1] if simpler else best, tuple(told)


def _tried(best: FittedModel, base: FittedModel, term: Term, linearised: Linearised, number: int) -> FittedModel:
    return _refined(_refitted(best, base, term, linearised, number), base)


def _gap(ranked: Ranked) -> float:
    return ranked.gap


def _own_p(found: Gains, terms: tuple[Term, ...], fit: FittedModel) -> float:
    """Of a fit's candidate, as if it were the only one."""
    return float(found.log_p[terms.index(fit.model.terms[-1]), 0].exp())


def _with_tangents(
    fits: Sequence[FittedModel], terms: tuple[Term, ...]
) -> tuple[FittedModel, tuple[Term, ...], Tangents]:
    """The first fit that has finite tangents, with them and their candidates, its own shape included."""
    for fit in fits:
        own = fit.model.terms[-1]
        tried = terms if own in terms else (*terms, own)
        try:
            return fit, tried, tangents_of(fit.model, fit.parameters, tried)
        except ValueError:
            if fit is fits[-1]:
                raise
    raise AssertionError


Start = tuple[Tensor, tuple[Tensor, Tensor]]
"""Parameters to linearise around, and the pseudo-residual there with what counts of it."""

Listed = tuple[Term, Tensor, Tensor]
"""A candidate worth a joint refit, with the parameters and the γ to start from."""


def _short_list(
    base: FittedModel, terms: tuple[Term, ...], starts: Sequence[Start], most: int, likeliest: Float[Tensor, " C"]
) -> list[Listed]:
    """Of each start the strongest candidates, noise taken for white; ``likeliest`` takes the log of each one's p."""
    chosen: dict[Key, Listed] = {}
    known: dict[int, Tangents] = {}
    for parameters, (pseudo, counts) in starts:
        if id(parameters) not in known:
            known[id(parameters)] = tangents_of(base.model, parameters, terms)
        plain = linearise(base.model, parameters, pseudo, counts, known[id(parameters)], white=True, wander=False)
        log_p = plain.search.gains(plain.series.unsqueeze(-1)).log_p[:, 0]
        torch.minimum(likeliest, log_p, out=likeliest)
        taken = 0
        for number in log_p.argsort().tolist():
            term = terms[number]
            if term.key not in chosen:
                gamma, _ = plain.search.estimate(number, plain.series)
                if one_sided(term.effect):
                    gamma = gamma.clamp(max=0.0)
                    if not bool(gamma.any()):
                        continue
                chosen[term.key] = term, parameters, -gamma
                taken += 1
            if taken >= most:
                break
    if not chosen:
        # none has a size of a sign that its physics allows; one of them is still to be told to be nothing
        chosen[terms[0].key] = terms[0], starts[0][0], starts[0][0].new_zeros(_size(terms[0], base))
    return list(chosen.values())


def _size(term: Term, base: FittedModel) -> int:
    return base.model.with_term(term).sizes[-1]


def _part_starts(base: FittedModel, d: Float[Tensor, " m"]) -> list[Start]:
    """Around fits to parts of the recording; those only that fit their part clearly better than d allows for."""
    prepared = base.model.prepared
    N = len(prepared.time)
    starts = []
    for part in range(_PARTS):
        rows = torch.zeros(N, dtype=torch.bool)
        rows[part * N // _PARTS : (part + 1) * N // _PARTS] = True
        try:
            theta = prepared.start(rows)
        except ValueError:
            continue
        parameters = torch.cat([theta, base.parameters[base.model.base :]])
        residual = base.model.residual(parameters)
        if bool((robust_scale(residual[rows]) < _BETTER * d).any()):
            starts.append((parameters, clipped_residual(residual)))
    return starts


def _first_start(base: FittedModel) -> list[Start]:
    """Around where the fit began, if a parameter of the equations went far from there: what they lack can drive it."""
    prepared = base.model.prepared
    if not isinstance(prepared, Beginning):
        return []
    theta, own = prepared.start(), base.model.base - prepared.beginnings
    sizes = torch.stack([theta[:own], base.parameters[:own]]).abs()
    if not bool((sizes.amax(0) > _AWAY * sizes.amin(0)).any()):
        return []
    parameters = torch.cat([theta, base.parameters[base.model.base :]])
    residual = base.model.residual(parameters)
    return [(parameters, clipped_residual(residual))] if bool(residual.isfinite().all()) else []


def _strongest(base: FittedModel, terms: tuple[Term, ...], prefer: Preference, *, parts: bool) -> list[FittedModel]:
    """The joint refits, the likeliest first; the leading ones each at its best shape, and behind them the others.

    Candidates are ranked by the likelihood's own score and by a clipped one, which still sees a stretch of samples that
    the fit rejects; and, where one model over all of the recording runs away, around fits to parts of it, and around
    where its fit began.
    """
    around, likeliest = base.parameters, base.parameters.new_zeros(len(terms))
    listed = _short_list(base, terms, [(around, base.pseudo)], _SHORT_LIST, likeliest)
    listed += _short_list(base, terms, [(around, clipped_residual(base.residual))], 2, likeliest)
    fits: dict[Key, FittedModel] = {}
    _refit_all(fits, base, listed, prefer)
    if parts:
        least = torch.stack([fit.d for fit in fits.values()]).amin(0)
        starts = [*_part_starts(base, least), *_first_start(base)]
        _refit_all(
            fits,
            base,
            [one for start in starts for one in _short_list(base, terms, [start], 2, likeliest)],
            prefer,
        )
    leading = sorted(fits.values(), key=lambda fit: _score(fit, base, prefer), reverse=True)[: _LEADING + 1]
    close = max(_THIRD * _score(leading[0], base, prefer), _MUCH)
    leading = [fit for place, fit in enumerate(leading) if place < _LEADING or _score(fit, base, prefer) > close]
    order = [terms[number] for number in likeliest.argsort().tolist()]

    def shaped_best(fit: FittedModel) -> FittedModel:
        fit.model.residual(fit.parameters)  # what other shapes of it begin with, where a simulation remembers
        return _refined(_best_shape(fit, base, order, prefer), base)

    shaped = fitted_each(base, [partial(shaped_best, fit) for fit in leading], terms)
    shaped = [fit for fit in shaped if _repeats(fit)] or [fit for fit in fits.values() if _repeats(fit)]
    if not shaped:
        raise ValueError(
            f"The simulation gave finite outputs while {len(fits)} effects were fitted, and gives none now at the same "
            "parameters: it is at the edge of what can be solved. Shorten the experiments, or give a `segment`."
        )
    keys = {fit.model.terms[-1].key for fit in shaped}
    parted = shaped, [fit for key, fit in fits.items() if key not in keys]
    return [fit for part in parted for fit in sorted(part, key=lambda fit: _score(fit, base, prefer), reverse=True)]


def _repeats(fit: FittedModel) -> bool:
    """Whether the simulation is finite there once more: a trajectory found on the way of a fit may be lost again."""
    return bool(fit.model.residual(fit.parameters).isfinite().all())


def _refit_all(fits: dict[Key, FittedModel], base: FittedModel, listed: Sequence[Listed], prefer: Preference) -> None:
    """Put the joint refit of each into ``fits``, where it is the better one of its physics."""
    first: dict[tuple[Key, int], Listed] = {}
    for one in listed:
        first.setdefault((one[0].key, id(one[1])), one)
    works = [
        partial(fitted_beside, base, base.model.with_term(term), torch.cat([parameters, gamma]))
        for term, parameters, gamma in first.values()
    ]
    found = fitted_each(base, works, [term for term, _, _ in first.values()])
    for (key, _), fit in zip(first, found, strict=True):
        if key not in fits or _score(fit, base, prefer) > _score(fits[key], base, prefer):
            fits[key] = fit


def _score(fit: FittedModel, base: FittedModel, prefer: Preference) -> float:
    """Gain in nats less Schwarz's penalty, and less what a curve without a name has to exceed a named effect by."""
    gain = fit.log_likelihood - base.log_likelihood
    score = gain - 0.5 * fit.model.sizes[-1] * math.log(len(fit.residual))
    return score - prefer.handicap(fit.model.terms[-1], gain)


def _best_shape(fit: FittedModel, base: FittedModel, terms: Sequence[Term], prefer: Preference) -> FittedModel:
    """The fit, or a better one with another shape of the same effect, the likeliest of ``terms`` first.

    Onsets are many, and closed in on later.
    """
    own = fit.model.terms[-1]
    others = [t for t in terms if t.key == own.key and t.shape != own.shape]
    if "onset" in own.shape or not others:
        return fit
    refits = [_reshaped(fit, base, other) for other in others[:_SHAPES]]
    return max([fit, *refits], key=lambda f: _score(f, base, prefer))


def _reshaped(fit: FittedModel, base: FittedModel, term: Term) -> FittedModel:
    model = base.model.with_term(term)
    kept = fit.parameters[: model.size]
    more = kept.new_zeros(model.size - len(kept))
    return fitted_beside(base, model, torch.cat([kept, more]), graduate=False)


def _judged(
    linearised: Linearised,
    noise: NoiseFit,
    found: Gains,
    possible: Bool[Tensor, " tried"],
    count: int,
    generator: torch.Generator,
) -> tuple[float, float]:
    """The p-value of the strongest candidate after the whole search, and how far it is beyond draws of fitted noise.

    Coloured noise is drawn where it enters, at a port whose axes may turn against the residual. A wander that chance
    makes likely is not drawn: half of all white noise fits one. Each candidate's ratios are first divided by how much
    the draws exceed their chi-square (Bartlett's correction), so that one whose noise is larger than the model's does
    not set the level for all. A shape that was closed in on, beyond those that were tried, is left out: the draws had
    no such choice. So is an amplitude of a sign that the physics does not allow.

    Where draws come up to the strongest candidate, recording and draws are compared a second time, by
    :func:`own_colour_gains`; the p-value is that of the smaller of both ranks.
    """
    stationary = linearised.entering(count, generator)
    if stationary is None:
        stationary = linearised.search.white(count, generator)
    if noise.gain > _WANDERS:
        stationary = stationary + linearised.search.wander(count, noise, generator)
    drawn = linearised.search.gains(stationary)
    dof = found.dof.clamp(min=1.0)
    excess = (drawn.ratio.mean(-1) / dof).clamp(min=1.0).unsqueeze(-1)
    tried = len(possible)
    own = log_survival(found.ratio / excess, dof.unsqueeze(-1))[:tried, 0]
    own = torch.where(possible, own, 0.0).amin()
    others = log_survival(drawn.ratio / excess, dof.unsqueeze(-1))[:tried].amin(0)
    beyond = float(others.min() - own)
    if beyond > 0 or not bool(possible.any()):
        return (1 + int((others <= own).sum())) / (1 + count), beyond
    series = torch.cat([linearised.series.unsqueeze(-1), stationary], -1)
    allowed = torch.cat([possible, possible.new_zeros(len(found.dof) - tried)])
    gains = own_colour_gains(linearised, series, allowed)
    return _either(-torch.cat([own.unsqueeze(0), others]), gains), beyond


def _either(one: Float[Tensor, " B"], other: Float[Tensor, " B"]) -> float:
    """The p-value of the first of B series, by the better of its ranks in two statistics that are large for effects.

    Of series that could change places no more than a share p has a p-value of p or less, however the statistics hang
    together.
    """
    rank = torch.minimum(*[(values >= values.unsqueeze(-1)).sum(-1) for values in (one, other)])
    return float((rank <= rank[0]).double().mean())


def _possible(terms: tuple[Term, ...], linearised: Linearised) -> Bool[Tensor, " C"]:
    """Whether the amplitudes that fit have a sign that the physics allows."""
    possible = torch.ones(len(terms), dtype=torch.bool)
    for number, term in enumerate(terms):
        if one_sided(term.effect):
            possible[number] = bool((linearised.search.estimate(number, linearised.series)[0] < 0).any())
    return possible


def _ranking(
    terms: tuple[Term, ...], found: Gains, prefer: Preference, possible: Bool[Tensor, " C"]
) -> tuple[Ranked, ...]:
    """By gain in nats less one for each parameter and each number of the shape (Akaike's criterion), each physics at
    its best possible shape."""
    gain = 0.5 * found.ratio[:, 0]
    numbers = gain.new_tensor([float(len(_continuous(term))) for term in terms])
    handicap = [prefer.handicap(term, float(one)) for term, one in zip(terms, gain, strict=True)]
    score = gain - found.dof - numbers - gain.new_tensor(handicap)
    score = torch.where((found.dof > 0) & possible, score, -torch.inf)
    best: dict[Key, int] = {}
    for number in score.argsort(descending=True).tolist():
        best.setdefault(terms[number].key, number)
    return tuple(Ranked(number, float(gain[number]), float(score.max() - score[number])) for number in best.values())


def _refitted(best: FittedModel, base: FittedModel, term: Term, linearised: Linearised, number: int) -> FittedModel:
    gamma, _ = linearised.search.estimate(number, linearised.series)
    gamma = gamma.clamp(max=0.0) if one_sided(term.effect) else gamma
    start = torch.cat([best.parameters[: base.model.size], -gamma])
    return fitted_beside(base, base.model.with_term(term), start)


def _refined(best: FittedModel, base: FittedModel, *, again: bool = False) -> FittedModel:
    """The fit with the likeliest values of its shape's continuous numbers, closed in on one by one.

    Args:
        best: the fit.
        base: what it is beside.
        again: once more from there, with the amplitudes that fit the new shape.
    """
    term = best.model.terms[-1]
    names = _continuous(term)
    if not names:
        return best
    for count in range(_ROUNDS):
        for name in names:
            shapes = finer(term, name, base.model.prepared.time, count)
            value = [_energy(best, base.model.with_term(shape)) for shape in shapes]
            term = shapes[min(range(len(shapes)), key=value.__getitem__)]
    moved = fitted_beside(base, base.model.with_term(term), best.parameters, graduate=False)
    if not (moved.log_likelihood > best.log_likelihood and _repeats(moved)):
        return best
    return _refined(moved, base) if again else moved


def _settled(fit: FittedModel, base: FittedModel) -> FittedModel:
    """The fit; begun anew where it ran out of steps: they can wait for a scale that is still far too large."""
    if fit.converged:
        return fit
    again = fitted_beside(base, fit.model, fit.parameters, graduate=False)
    return again if again.log_likelihood > fit.log_likelihood and _repeats(again) else fit


def _closer(
    terms: Sequence[Term],
    model: JointModel,
    parameters: Tensor,
    tangents: Tangents,
    counts: Float[Tensor, "N m"],
    linearised: Linearised,
) -> tuple[Term, ...]:
    """Candidates with the continuous numbers of their shapes closed in on under the noise of the search.

    Only where a port is pointwise: elsewhere each shape takes a trajectory of its own.
    """
    closer = []
    for term in terms:
        names = _continuous(term)
        if not names or tangents.pointwise[term.port] is None:
            continue
        found = term
        for count in range(_ROUNDS):
            for name in names:
                shapes = finer(found, name, model.prepared.time, count)
                gains = linearised.gains_of(candidate_tangents(model, parameters, shapes, tangents.pointwise), counts)
                found = shapes[int(gains.ratio[:, 0].argmax())]
        if found.shape != term.shape:
            closer.append(found)
    return tuple(closer)


def _continuous(term: Term) -> list[str]:
    free = term.effect.continuous if isinstance(term.effect, ContinuousEffect) else {}
    return [name for name in term.shape if name in free]


def _energy(fit: FittedModel, model: JointModel) -> float:
    """Of another shape, at the same parameters."""
    return float(mkc_energy(model.residual(fit.parameters), fit.sigma, fit.d).sum())
