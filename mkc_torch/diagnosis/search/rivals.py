"""Rivals of what a search has named: whether they keep its gain once fitted, and what they leave that is new."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.parallel import run_parallel
from mkc_torch.diagnosis.model.term import Key, Term
from mkc_torch.diagnosis.search.joint_refits import refitted
from mkc_torch.diagnosis.search.linearized import LinearizedSearch
from mkc_torch.diagnosis.search.model_prior import ModelPrior, schwarz
from mkc_torch.diagnosis.search.ranking import Ranked
from mkc_torch.diagnosis.search.shape_refinement import refined

__all__ = ["by_joint_fits"]


def by_joint_fits(
    best: FittedModel,
    ranking: tuple[Ranked, ...],
    look: LinearizedSearch,
    prefer: ModelPrior,
    known: Sequence[FittedModel],
) -> tuple[FittedModel, tuple[Ranked, ...]]:
    """The fit, or a simpler one that is no worse; and the ranking, with rivals that lose much of their gain put back.

    A port that is not pointwise bends the trajectory: a rival of the search can follow the one that the effect has
    made, and yet not make one like it. So those that the search has as near as the effect are fitted, unless a
    ``known`` fit keeps the gain.
    """
    base, terms, own = look.scene.base, look.scene.terms, best.model.terms[-1].key
    naming = look.settings.naming
    reach = naming.separable + max([one.gap for one in ranking if terms[one.number].key == own], default=0.0)
    near = [
        one
        for one in ranking
        if one.gap < reach and terms[one.number].key != own and look.scene.bends(terms[one.number])
    ]
    won = prefer.score(best, base)
    fitted = {fit.model.terms[-1].key: fit for fit in reversed(known) if prefer.score(fit, base) >= naming.kept * won}
    new = [one for one in near if terms[one.number].key not in fitted]
    works = [partial(_tried, best, terms[one.number], look, one.number) for one in new]
    for fit in run_parallel(works, base.model.prepared, [terms[one.number] for one in new]):
        fitted[fit.model.terms[-1].key] = fit
    fits = [fitted[terms[one.number].key] for one in near]
    scores = [prefer.score(fit, base) for fit in fits]
    behind = {one.number: won - score for one, score in zip(near, scores, strict=True) if score < naming.kept * won}
    told = sorted((replace(one, gap=max(one.gap, behind.get(one.number, 0.0))) for one in ranking), key=_gap)
    told = [replace(one, gap=one.gap - told[0].gap) for one in told]
    simpler = [
        (score, fit)
        for score, fit in zip(scores, fits, strict=True)
        if fit.model.sizes[-1] < best.model.sizes[-1]
        and score >= won
        and prefer.by_innovations(best, fit, schwarz(best)) >= 0.0
    ]
    if simpler:
        return max(simpler, key=lambda one: one[0])[1], tuple(told)
    bent = [fit for fit in known if look.scene.bends(fit.model.terms[-1])]
    return _by_innovations(best, tuple(told), terms, prefer, [*fits, *bent], naming.separable)


def _by_innovations(
    best: FittedModel,
    ranking: tuple[Ranked, ...],
    terms: tuple[Term, ...],
    prefer: ModelPrior,
    fits: Sequence[FittedModel],
    separable: float,
) -> tuple[FittedModel, tuple[Ranked, ...]]:
    """The fit, or one of another physics that clearly leaves less in coloured noise; and the ranking by that.

    Joint fits take noise for white, and one that follows its slow course wins by it. What is new in each sample tells
    two physics apart that are alike in the long run.
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
    told = [
        replace(one, gap=0.0 if key == own else max(one.gap, behind.get(key, 0.0)))
        for one, key in ((one, terms[one.number].key) for one in ranking)
    ]
    return best, tuple(sorted(told, key=_gap))


def _tried(best: FittedModel, term: Term, look: LinearizedSearch, number: int) -> FittedModel:
    return refined(refitted(best, term, look, number), look.scene.base)


def _gap(one: Ranked) -> float:
    return one.gap
