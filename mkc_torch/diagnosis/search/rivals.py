"""Rivals of the named effect: whether they keep its gain once fitted, and how their innovations compare."""

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
    """Return the fit, or a simpler fit that is no worse; and the ranking, with rivals that lose their gain moved back.

    At a port that is not pointwise the search is linear along a trajectory that the effect has shaped: a rival can
    follow that trajectory, but not produce it. So rivals as near as the effect are fitted, unless a ``known`` fit keeps
    the gain.
    """
    base, terms, own = look.scene.base, look.scene.terms, best.model.terms[-1].key
    naming = look.settings.naming
    reach = naming.separable + max([rival.gap for rival in ranking if terms[rival.number].key == own], default=0.0)
    near = [
        rival
        for rival in ranking
        if rival.gap < reach and terms[rival.number].key != own and look.scene.is_nonlinear(terms[rival.number])
    ]
    won = prefer.score(best, base)
    fitted = {fit.model.terms[-1].key: fit for fit in reversed(known) if prefer.score(fit, base) >= naming.kept * won}
    new = [rival for rival in near if terms[rival.number].key not in fitted]
    works = [partial(_tried, best, terms[rival.number], look, rival.number) for rival in new]
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


def _tried(best: FittedModel, term: Term, look: LinearizedSearch, number: int) -> FittedModel:
    return refined(refitted(best, term, look, number), look.scene.base)


def _gap(rival: Ranked) -> float:
    return rival.gap
