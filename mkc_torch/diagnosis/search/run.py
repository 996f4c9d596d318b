"""Locate and name: the strongest candidate beside a fit, how sure it is after the whole search, and its rivals."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch._parallel.pool import speculative
from mkc_torch.diagnosis.linearised.candidates import Candidates, one_after_the_other
from mkc_torch.diagnosis.linearised.drift import NoiseFit
from mkc_torch.diagnosis.linearised.drift_residuals import drift_residuals
from mkc_torch.diagnosis.linearised.linearise import LinearisedSearch
from mkc_torch.diagnosis.linearised.tangents import ModelTangents, tangents_of
from mkc_torch.diagnosis.model.fit import FittedModel, fitted_beside
from mkc_torch.diagnosis.model.parallel import common_parts
from mkc_torch.diagnosis.model.shaped import shape_fitted
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.noise.spectrum import NoiseSpectrum
from mkc_torch.diagnosis.search.joint_refits import refitted, strongest
from mkc_torch.diagnosis.search.linearized import LinearizedSearch, SearchProblem
from mkc_torch.diagnosis.search.localised import telling_stretch
from mkc_torch.diagnosis.search.model_prior import ModelPrior
from mkc_torch.diagnosis.search.p_value import judged
from mkc_torch.diagnosis.search.quick import any_pays
from mkc_torch.diagnosis.search.ranking import Ranked, ranked
from mkc_torch.diagnosis.search.rivals import by_joint_fits
from mkc_torch.diagnosis.search.shape_refinement import refine_candidates, refined, with_spectrum
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.nonlinear import NoFitError

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["SearchResult", "run_search"]


@dataclass(frozen=True)
class SearchResult:
    """The outcome of a search.

    Attributes:
        term: the strongest candidate, at its best shape.
        fit: the joint refit with it.
        p_value: after the whole search, and no less than the candidate's own.
        beyond: nats by which it is rarer, by itself, than the strongest of the draws.
        ranking: for each candidate physics its best shape, gain in nats, and nats behind the first; best first.
        noise: the wander of the noise without the candidate.
        look: the search that told candidates apart.
        beside_nothing: the search that the p-value is from; that of ``look`` is another one where an effect was named.
        stretch: samples without which there is nothing, first and the one after the last, if they are few.
        compared: fits of the leading candidates, each under the noise of the world that it leaves; none where all are
            under the same.
        longer: times as long a recording that would show it has to be, if it is there; infinite where nobody knows.
        with_noise: whether noise and physics were chosen together.
        alone: the simulation without the candidate, where noise that was found beside the candidate makes both as
            likely, and likelier than any noise that the simulation had; None elsewhere.
    """

    term: Term
    fit: FittedModel
    p_value: float
    beyond: float
    ranking: tuple[Ranked, ...]
    noise: NoiseFit
    look: LinearizedSearch
    beside_nothing: LinearisedSearch
    stretch: tuple[int, int] | None = None
    compared: Sequence[FittedModel] = ()
    longer: float = math.inf
    with_noise: bool = False
    alone: FittedModel | None = None

    @property
    def scene(self) -> SearchProblem:
        """The candidates, and the residuals that they would have to explain."""
        return self.look.scene


def run_search(
    base: FittedModel,
    terms: Sequence[Term],
    *,
    level: float,
    surrogates: int,
    generator: torch.Generator,
    settings: Settings,
    parts: bool = True,
    quick: bool = False,
    keep: Callable[[SearchResult], object] = lambda _: None,
) -> SearchResult:
    """Search the candidates beside a fit.

    Args:
        base: the simulation with what was found so far.
        terms: candidates.
        level: below which p-value the candidate is named with care.
        surrogates: draws of noise that the strongest candidate is judged against, of each kind of noise.
        generator: of the draws.
        settings: the numbers that decide.
        parts: also start from fits to parts of the recording, for where one model over all of it runs away.
        quick: draw no noise; the strongest candidate counts if it gains more than its price.
        keep: called with what is known before the strongest candidate is named with care.
    """
    terms = tuple(terms)
    prefer = ModelPrior(terms, base.model.prepared, settings.naming)
    tried = len(terms)
    fits, tangents = strongest(base, terms, prefer, settings, parts=parts)
    best, scene = _scene(base, fits, terms, tangents, settings)
    # without the effect, as what is left beside it weighs the samples
    left = drift_residuals(best, base.model, scene.around.parameters[: base.model.size], scene.tangents, settings.noise)
    added = _added(best, scene)
    scene = replace(
        scene,
        tangents=replace(scene.tangents, slow=left.slow),
        values=left.values - left.counts * added,
        counts=left.counts,
    )
    naming = partial(_named, best, scene, left.noise.spectrum, prefer, level)
    known = [base, best, *terms, *scene.parts, *common_parts(base.model.prepared, scene.terms)]
    # a copy names it already, while this process asks whether there is anything to be named
    with speculative([naming], known) as answer:
        look = seen = scene.under()
        p_value, beyond = (
            (any_pays(look, look.possible[:tried]), math.inf) if quick else _judged(look, tried, surrogates, generator)
        )
        noise, beside_nothing = look.noise, look.linearised
        if p_value <= level and beyond < settings.search.doubted:
            for spectrum in look.linearised.plausible(settings.noise.plausible):
                p_other, beyond_other = _judged(scene.under(spectrum), tried, surrogates, generator)
                p_value, beyond = max(p_value, p_other), min(beyond, beyond_other)
        stretch = None
        if p_value <= level:
            own = int(torch.where(look.possible, look.gains.log_p[:, 0], 0.0).argmin())
            trace = scene.counts * (scene.tangents.candidates[own] @ look.estimate(own))
            stretch = telling_stretch(scene.values, scene.counts, trace, scene.tangents.nuisance, settings)
        if stretch is not None:
            rest = scene.without(stretch).under()
            p_other, beyond_other = (
                (any_pays(rest, rest.possible[:tried]), math.inf)
                if quick
                else _judged(rest, tried, surrogates, generator)
            )
            p_value, beyond = max(p_value, p_other), min(beyond, beyond_other)
            beside_nothing = rest.linearised
        ranking = ranked(look, prefer)
        keep(SearchResult(best.model.terms[-1], best, p_value, beyond, ranking, noise, seen, beside_nothing))
        if p_value <= level:
            [named] = answer()
            best, ranking, seen = named.fit, named.ranking, named.look
            # it was another candidate that no draw came up to, if this one by itself is nothing out of the ordinary
            p_value = max(p_value, seen.own_p(best.model.terms[-1]))
    if p_value <= level:
        best, ranking = by_joint_fits(best, ranking, seen, prefer, fits)
        best = _settled(refined(best, base, again=True), base)
        best = with_spectrum(best, seen)
        best = shape_fitted(best)
    return SearchResult(
        best.model.terms[-1],
        best,
        p_value,
        beyond,
        ranking,
        noise,
        seen,
        beside_nothing,
        stretch if p_value > level else None,
    )


def _scene(
    base: FittedModel, fits: Sequence[FittedModel], terms: tuple[Term, ...], tangents: ModelTangents, settings: Settings
) -> tuple[FittedModel, SearchProblem]:
    """The first fit that can be looked at, and the candidates where they are linear, its own shape included."""
    if _shows(base, fits[0], settings):
        best = around = fits[0]
        around, own = base, best.model.terms[-1]
        if own not in terms:
            more = Candidates(base.model, base.parameters, [own], tangents.pointwise)
            terms, tangents = (
                (*terms, own),
                replace(tangents, candidates=one_after_the_other(tangents.candidates, more)),
            )
    else:
        best, terms, tangents = _with_tangents(fits, terms, settings)
        around = best
    tangents = replace(tangents, nuisance=tangents.nuisance[..., : base.model.size])
    return best, SearchProblem(
        base, around, terms, tangents, around.residual, torch.ones_like(around.residual), settings
    )


def _added(best: FittedModel, scene: SearchProblem) -> Float[Tensor, "N m"]:
    """What the effect of a fit adds to the residual."""
    if scene.around is scene.base:
        return best.residual - scene.base.residual
    number, gamma = scene.terms.index(best.model.terms[-1]), best.parameters[scene.base.model.size :]
    return torch.einsum("nmq,q->nm", scene.tangents.candidates[number], gamma)


def _shows(base: FittedModel, fit: FittedModel, settings: Settings) -> bool:
    """Whether a fit without an effect shows what there is of it: it rejects no more, and its scale is no larger.

    Then tangents there are the ones to judge it by. At a fit with it, an effect that is nearly not to be seen may have
    any size, as a step has while the sensor rests, and what is linear about that size says nothing about none. Where an
    effect bends a trajectory, tangents at the fit with it are the ones.
    """
    if fit.model.prepared.ports[fit.model.terms[-1].port].clock is not None:
        return False
    least, search = settings.noise.rejected_below, settings.search
    rejected = (base.weights < least) & (fit.weights >= least)
    return float(rejected.double().mean()) < search.hidden and bool((fit.d > search.smaller * base.d).all())


def _judged(look: LinearizedSearch, tried: int, surrogates: int, generator: torch.Generator) -> tuple[float, float]:
    """As :func:`judged` says, of the strongest of the first candidates."""
    noise = look.settings.noise
    return judged(look.linearised, look.noise, look.gains, look.possible[:tried], surrogates, generator, noise)


class _NamedEffect(NamedTuple):
    """What an effect is, if there is one: the fit with it, and the look that told it from others."""

    fit: FittedModel
    ranking: tuple[Ranked, ...]
    look: LinearizedSearch


def _named(
    best: FittedModel, scene: SearchProblem, spectrum: NoiseSpectrum, prefer: ModelPrior, level: float
) -> _NamedEffect:
    """Whether there is an effect is asked of the noise that has it in; which one it is, of the noise beside it."""
    look, base, naming = scene.under(spectrum), scene.base, scene.settings.naming
    near = [scene.terms[one.number] for one in ranked(look, prefer) if one.gap < 2.0 * naming.separable]
    look = look.with_more(refine_candidates(near, look))
    terms, ranking = look.scene.terms, ranked(look, prefer)
    first, own = terms[ranking[0].number], best.model.terms[-1]
    bends = any(scene.bends(term) for term in (first, own))
    if first.key != own.key or look.own_p(own) > level:
        other = refitted(best, first, look, ranking[0].number)
        # the search is linear: where the joint fit loses much of the gain, it went too far; but where noise may wander,
        # what follows the wander gains most in joint fits, and the search knows better if it tells the two apart
        behind = [one.gap for one in ranking if terms[one.number].key == own.key]
        clear = scene.tangents.slow is not None and not (behind and behind[0] < naming.separable)
        least = 0.0 if clear else naming.kept * max(prefer.score(best, base), 0.0)
        gain = other.log_likelihood - base.log_likelihood if clear else prefer.score(other, base)
        if gain > least or (bends and prefer.by_innovations(best, other) > 0.0):
            best = other
    return _NamedEffect(best, ranking, look)


def _with_tangents(
    fits: Sequence[FittedModel], terms: tuple[Term, ...], settings: Settings
) -> tuple[FittedModel, tuple[Term, ...], ModelTangents]:
    """The first fit that has finite tangents, with them and their candidates, its own shape included."""
    for fit in fits:
        own = fit.model.terms[-1]
        tried = terms if own in terms else (*terms, own)
        try:
            return fit, tried, tangents_of(fit.model, fit.parameters, settings.noise, tried)
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
