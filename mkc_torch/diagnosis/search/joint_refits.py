"""Joint refits: of the most promising candidates before the search, of the closest rivals after it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, compress
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.diagnosis.model.fit import FittedModel, clipped_residual, fitted_with_effect
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Key, Term, run_parallel
from mkc_torch.diagnosis.search.linearise import linearise
from mkc_torch.diagnosis.search.problem import CandidateSearch, refined
from mkc_torch.diagnosis.search.ranking import ModelPrior, Ranked, best_first, in_order, schwarz, within_reach
from mkc_torch.diagnosis.search.tangents import ModelTangents, tangents_of
from mkc_torch.diagnosis.settings import SearchSettings, Settings
from mkc_torch.nonlinear import NoFitError

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

T = TypeVar("T")


Start = tuple[Tensor, tuple[Tensor, Tensor]]
"""Parameters to linearise at, and the pseudo-residual there with its mask."""

Listed = tuple[Term, Tensor]
"""A candidate for a joint refit, with the initial parameters, γ last."""


def strongest(
    base: FittedModel, terms: tuple[Term, ...], prefer: ModelPrior, settings: Settings, *, parts: bool
) -> tuple[list[FittedModel], ModelTangents]:
    """Refit the most promising candidates jointly with the baseline; return the fits, best first, and the tangents.

    The leading fits come first, each at its best shape, then the others. The tangents are those at the baseline fit.

    Candidates are ranked by the likelihood's own score and by a clipped score, which still sees a stretch of samples
    that the fit rejects. In case one model of the whole recording diverges, they are also ranked at fits to parts of
    the recording.
    """
    around = base.parameters
    noise, search = settings.noise, settings.search
    tangents = tangents_of(base.model, around, noise, terms)
    looks = [
        ((around, base.pseudo(noise)), search.refitted),
        ((around, clipped_residual(base.residual, base.recorded)), search.refitted_elsewhere),
    ]
    works = [partial(_short_list, base, terms, start, tangents, most) for start, most in looks]
    lists = run_parallel(works, base.model.prepared, terms)
    fits: dict[Key, FittedModel] = {}
    fitted_parts = _part_fits(base, search.parts) if parts else []
    listed: dict[Key, Listed] = {}
    for entry in chain(*(chosen for chosen, _ in lists)):
        listed.setdefault(entry[0].key, entry)
    starts = _refit_all(fits, base, list(listed.values()), prefer, fitted_parts)
    if parts:
        least = torch.stack([fit.d for fit in fits.values()]).amin(0)
        started = [
            part.start for part in starts if part is not None and bool((part.scale < search.part_better * least).any())
        ]
        more = [
            _short_list(base, terms, start, tangents_of(base.model, start[0], noise, terms), search.refitted_elsewhere)
            for start in started
        ]
        _refit_all(fits, base, [*chain(*(chosen for chosen, _ in more))], prefer)
        lists += more
    best_log_p = torch.stack([log_p for _, log_p in lists]).amin(0)
    order = [terms[number] for number in in_order((-best_log_p).tolist(), terms)]
    leading = _at_best_shapes(_leading(list(fits.values()), base, prefer, search), base, order, prefer, search.shapes)
    shaped = run_parallel(
        [partial(refined, fit, base) for fit in leading], base.model.prepared, terms, "leading candidate"
    )
    keys = {fit.model.terms[-1].key for fit in shaped}
    parted = shaped, [fit for key, fit in fits.items() if key not in keys]
    fitted = [fit for part in parted for fit in best_first(part, base, prefer)]
    return fitted, tangents


def _short_list(
    base: FittedModel, terms: tuple[Term, ...], start: Start, tangents: ModelTangents, most: int
) -> tuple[list[Listed], Float[Tensor, " C"]]:
    """Return the strongest candidates under white noise, and log p of each candidate."""
    parameters, (pseudo, counts) = start
    plain = linearise(base.model, parameters, pseudo, counts, tangents, white=True, drift=False)
    log_p = plain.search.gains(plain.series.unsqueeze(-1)).log_p[:, 0]
    chosen: dict[Key, Listed] = {}
    for number in in_order((-log_p).tolist(), terms):
        term = terms[number]
        if term.key not in chosen:
            gamma, _ = plain.search.estimate(number, plain.series)
            if term.effect.one_sided:
                gamma = gamma.clamp(max=0.0)
                if not bool(gamma.any()):
                    continue
            chosen[term.key] = term, torch.cat([parameters, -gamma])
        if len(chosen) >= most:
            break
    if not chosen:
        # no candidate has an allowed sign; keep a candidate at size 0, which the search then rejects
        size = base.model.with_term(terms[0]).sizes[-1]
        chosen[terms[0].key] = terms[0], torch.cat([parameters, parameters.new_zeros(size)])
    return list(chosen.values()), log_p


@dataclass(frozen=True)
class _Part:
    """A fit to a part of the recording, as a start, and the robust scale of its residuals there."""

    start: Start
    scale: Float[Tensor, " m"]


def _part_fits(base: FittedModel, parts: int) -> list[Callable[[], _Part | None]]:
    """Return functions that fit parts of the recording; they return None if the part cannot be fitted."""
    N = len(base.model.prepared.time)

    def fit_to(rows: Bool[Tensor, " N"]) -> _Part | None:
        try:
            theta = base.model.prepared.start(rows)
        except NoFitError:
            return None
        parameters = torch.cat([theta, base.parameters[base.model.base :]])
        residual = base.model.residual(parameters)
        return _Part((parameters, clipped_residual(residual, base.recorded)), robust_scale(residual[rows]))

    part = torch.arange(N) * parts // N
    return [partial(fit_to, part == number) for number in range(parts)]


def _refit_all(
    fits: dict[Key, FittedModel],
    base: FittedModel,
    listed: Sequence[Listed],
    prefer: ModelPrior,
    further: Sequence[Callable[[], T]] = (),
) -> list[T]:
    """Store the best joint refit of each effect in ``fits``; return the results of further parallel functions."""
    works = [partial(fitted_with_effect, base, base.model.with_term(term), start) for term, start in listed]
    done: list[Any] = run_parallel(
        [*works, *further], base.model.prepared, [term for term, _ in listed], "fit of a candidate"
    )
    for (term, _), fit in zip(listed, done, strict=False):
        if term.key not in fits or prefer.score(fit, base) > prefer.score(fits[term.key], base):
            fits[term.key] = fit
    return done[len(works) :]


def _leading(
    fits: Sequence[FittedModel], base: FittedModel, prefer: ModelPrior, settings: SearchSettings
) -> list[FittedModel]:
    """Return the leading fits that are within reach of the first, and a further fit if it is close behind."""
    leading = settings.leading
    first = best_first(fits, base, prefer)[: leading + 1]
    scores = [prefer.score(fit, base) for fit in first]
    close = max(settings.third_share * scores[0], settings.third_nats)
    first = [fit for place, fit in enumerate(first) if place < leading or scores[place] > close]
    return list(compress(first, within_reach(scores, settings)))


def _at_best_shapes(
    fits: Sequence[FittedModel], base: FittedModel, terms: Sequence[Term], prefer: ModelPrior, most: int
) -> list[FittedModel]:
    """Return each fit, or a better fit of the same effect with another of the ``most`` most likely shapes in ``terms``.

    Onsets are many, and refined later.
    """
    tried = []
    for place, fit in enumerate(fits):
        own = fit.model.terms[-1]
        others = [t for t in terms if t.key == own.key and t.shape != own.shape]
        tried += [(place, other) for other in others[:most] if "onset" not in own.shape]
    works = [partial(_reshaped, fits[k], base, other) for k, other in tried]
    refits = run_parallel(works, base.model.prepared, terms, "shape of a leading candidate")
    best = list(fits)
    for (place, _), refit in zip(tried, refits, strict=True):
        best[place] = max(best[place], refit, key=lambda fit: prefer.score(fit, base))
    return best


def _reshaped(fit: FittedModel, base: FittedModel, term: Term) -> FittedModel:
    model = fit.model.with_last(term)
    kept = fit.parameters[: model.size]
    more = kept.new_zeros(model.size - len(kept))
    return fitted_with_effect(base, model, torch.cat([kept, more]), graduate=False)


def refitted(best: FittedModel, term: Term, look: CandidateSearch, number: int) -> FittedModel:
    """Return the joint fit of a candidate in place of another, from its size in the search."""
    base, gamma = look.scene.base, look.estimate(number)
    gamma = gamma.clamp(max=0.0) if term.effect.one_sided else gamma
    more_terms = len(best.model.terms) > len(base.model.terms)
    extended = best.model.with_last(term) if more_terms else best.model.with_term(term)
    found = fitted_with_effect(base, extended, torch.cat([best.parameters[: base.model.size], -gamma]))
    if found.log_likelihood >= base.log_likelihood:
        return found
    # the fit diverged from there; from size 0 the likelihood only increases
    model = base.model.with_term(term)
    return fitted_with_effect(base, model, torch.cat([base.parameters, torch.zeros_like(gamma)]), graduate=False)


def by_joint_fits(
    best: FittedModel,
    ranking: tuple[Ranked, ...],
    look: CandidateSearch,
    prefer: ModelPrior,
    known: Sequence[FittedModel],
) -> tuple[FittedModel, tuple[Ranked, ...]]:
    """Return the fit, or a simpler fit that is no worse; and the ranking, with rivals that lose their gain moved back.

    At a port that is not pointwise the search is linear around a fit that the effect has shaped: a rival can follow
    that fit, but not reach it. The same holds for an effect that scales a signal: next to it a fitted
    parameter and a constant gain differ by its factor, and without it they are equal. So rivals as near as the effect
    are fitted, unless a ``known`` fit keeps the gain.
    """
    base, terms, own = look.scene.base, look.scene.terms, best.model.terms[-1].key
    around = look.scene.around.model
    naming = look.settings.naming
    reach = naming.separable + max([rival.gap for rival in ranking if terms[rival.number].key == own], default=0.0)
    near = [
        rival
        for rival in ranking
        if rival.gap < reach
        and terms[rival.number].key != own
        and (look.scene.is_nonlinear(terms[rival.number]) or _in_series(terms[rival.number], around))
    ]
    won = prefer.score(best, base)
    fitted = {fit.model.terms[-1].key: fit for fit in reversed(known) if prefer.score(fit, base) >= naming.kept * won}
    new = [rival for rival in near if terms[rival.number].key not in fitted]
    works = [partial(refitted_rival, best, terms[rival.number], look, rival.number) for rival in new]
    for fit in run_parallel(works, base.model.prepared, [terms[rival.number] for rival in new]):
        fitted[fit.model.terms[-1].key] = fit
    fits = [fitted[terms[rival.number].key] for rival in near]
    scores = [prefer.score(fit, base) for fit in fits]
    behind = {rival.number: won - score for rival, score in zip(near, scores, strict=True) if score < naming.kept * won}
    moved = sorted((replace(rival, gap=max(rival.gap, behind.get(rival.number, 0.0))) for rival in ranking), key=_gap)
    moved = [replace(rival, gap=rival.gap - moved[0].gap) for rival in moved]
    simpler = [
        (score, fit)
        for score, fit in zip(scores, fits, strict=True)
        if fit.model.sizes[-1] < best.model.sizes[-1]
        and score >= won
        and prefer.by_innovations(best, fit, schwarz(best)) >= 0.0
    ]
    if simpler:
        return max(simpler, key=lambda scored: scored[0])[1], tuple(moved)
    nonlinear = [fit for fit in known if look.scene.is_nonlinear(fit.model.terms[-1])]
    return _by_innovations(best, tuple(moved), terms, prefer, [*fits, *nonlinear], naming.separable)


def _by_innovations(
    best: FittedModel,
    ranking: tuple[Ranked, ...],
    terms: tuple[Term, ...],
    prefer: ModelPrior,
    fits: Sequence[FittedModel],
    separable: float,
) -> tuple[FittedModel, tuple[Ranked, ...]]:
    """Return the fit, or a fit of another effect that is clearly better for coloured noise; and the ranking by that.

    Joint fits assume white noise, so a fit that follows slow noise wins by it. Innovations distinguish two effects that
    are alike at low frequencies.
    """
    if not fits:
        return best, ranking
    fits = [best, *fits]
    for fit in fits:
        another = fit.model.terms[-1].key != best.model.terms[-1].key
        if another and prefer.by_innovations(best, fit) > separable:
            best = fit
    own = best.model.terms[-1].key
    behind: dict[Key, float] = {}
    for fit in fits:
        key, gap = fit.model.terms[-1].key, prefer.by_innovations(fit, best)
        behind[key] = min(gap, behind.get(key, gap))
    moved = [
        replace(rival, gap=0.0 if key == own else max(rival.gap, behind.get(key, 0.0)))
        for rival, key in ((rival, terms[rival.number].key) for rival in ranking)
    ]
    return best, tuple(sorted(moved, key=_gap))


def _in_series(term: Term, model: JointModel) -> bool:
    """Whether the model's last effect changes the signal that a candidate of the same port depends on."""
    last = model.terms[-1] if model.terms else None
    if last is None or last.port != term.port or not (last.effect.follows_signal and term.effect.follows_signal):
        return False
    return model.prepared.ports[term.port].in_series(term.port)


def refitted_rival(best: FittedModel, term: Term, look: CandidateSearch, number: int) -> FittedModel:
    return refined(refitted(best, term, look, number), look.scene.base)


def _gap(rival: Ranked) -> float:
    return rival.gap
