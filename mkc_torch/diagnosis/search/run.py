"""The search under white or coloured noise with drift, and the screening after a finding."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch.diagnosis.model.fit import FittedModel, fitted_with_effect
from mkc_torch.diagnosis.model.shapes import shape_fitted
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.noise.drift import NoiseFit
from mkc_torch.diagnosis.noise.spectrum import NoiseSpectrum
from mkc_torch.diagnosis.search.estimate import drift_residuals
from mkc_torch.diagnosis.search.joint_refits import by_joint_fits, refitted, strongest
from mkc_torch.diagnosis.search.linearise import LinearisedSearch
from mkc_torch.diagnosis.search.problem import (
    CandidateSearch,
    SearchProblem,
    refine_candidates,
    refined,
    with_spectrum,
)
from mkc_torch.diagnosis.search.ranking import ModelPrior, Ranked, ranked
from mkc_torch.diagnosis.search.significance import any_pays, localised_stretch, surrogate_p_value
from mkc_torch.diagnosis.search.tangents import Candidates, ModelTangents, one_after_the_other, tangents_of
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.nonlinear import NoFitError

if TYPE_CHECKING:
    from jaxtyping import Float


@dataclass(frozen=True)
class SearchResult:
    """The result of a search.

    Attributes:
        term: the strongest candidate, at its best shape.
        fit: the joint refit with it.
        p_value: after the whole search, and no less than the candidate's own.
        beyond: nats by which its own p-value is below that of the strongest surrogate.
        ranking: for each effect its best shape, gain in nats, and nats behind the first; best first.
        noise: the drift of the noise without the candidate.
        look: the search that distinguished the candidates.
        tested_search: the search that the p-value is from; another than ``look`` if an effect was named.
        stretch: first and end sample of a short stretch that holds the evidence, if the effect fails without it.
        compared: fits of the leading candidates, each under its own remaining noise; empty if all share one noise.
        longer: ratio by which a recording has to be longer to show the effect, if it is real; infinite if unknown.
        with_noise: whether noise and physics were selected together.
        follow: open-loop fits with effects, most likely first, with which the simulation follows the recording far
            better, if no candidate passed the surrogates.
    """

    term: Term
    fit: FittedModel
    p_value: float
    beyond: float
    ranking: tuple[Ranked, ...]
    noise: NoiseFit
    look: CandidateSearch
    tested_search: LinearisedSearch
    stretch: tuple[int, int] | None = None
    compared: Sequence[FittedModel] = ()
    longer: float = math.inf
    with_noise: bool = False
    follow: tuple[FittedModel, ...] = ()

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
    """Search the candidates at a fit.

    Args:
        base: the simulation with the previous findings.
        terms: candidates.
        level: p-value up to which the candidate is named by slower comparisons.
        surrogates: number of surrogates, for each kind of noise.
        generator: of the surrogates.
        settings: thresholds.
        parts: also start from fits to parts of the recording, in case one model of all of it diverges.
        quick: draw no surrogates; the strongest candidate counts if it gains more than its penalty.
        keep: called with the result so far, before the slower comparisons.
    """
    terms = tuple(terms)
    prefer = ModelPrior(terms, base.model.prepared, settings.naming)
    tried = len(terms)
    fits, tangents = strongest(base, terms, prefer, settings, parts=parts)
    best, scene = _scene(base, fits, terms, tangents, settings)
    # the residual without the effect, with the mask and weights of the fit with it
    left = drift_residuals(best, base.model, scene.around.parameters[: base.model.size], scene.tangents, settings.noise)
    added = _added(best, scene)
    scene = replace(
        scene,
        tangents=replace(scene.tangents, slow=left.slow),
        values=left.values - left.counts * added,
        counts=left.counts,
    )
    look = seen = scene.under()
    p_value, beyond = (
        (any_pays(look, look.possible[:tried]), math.inf) if quick else _judged(look, tried, surrogates, generator)
    )
    noise, tested_search = look.noise, look.linearised
    if p_value <= level and beyond < settings.search.doubted:
        for spectrum in look.linearised.plausible(settings.noise.plausible):
            p_other, beyond_other = _judged(scene.under(spectrum), tried, surrogates, generator)
            p_value, beyond = max(p_value, p_other), min(beyond, beyond_other)
    stretch = None
    if p_value <= level:
        own = int(torch.where(look.possible, look.gains.log_p[:, 0], 0.0).argmin())
        trace = scene.counts * (scene.tangents.candidates[own] @ look.estimate(own))
        stretch = localised_stretch(scene.values, scene.counts, trace, scene.tangents.nuisance, settings)
    if stretch is not None:
        rest = scene.without(stretch).under()
        p_other, beyond_other = (
            (any_pays(rest, rest.possible[:tried]), math.inf) if quick else _judged(rest, tried, surrogates, generator)
        )
        p_value, beyond = max(p_value, p_other), min(beyond, beyond_other)
        tested_search = rest.linearised
    ranking = ranked(look, prefer)
    keep(SearchResult(best.model.terms[-1], best, p_value, beyond, ranking, noise, seen, tested_search))
    if p_value <= level:
        named = _named(best, scene, left.noise.spectrum, prefer, level)
        best, ranking, seen = named.fit, named.ranking, named.look
        # if the named candidate's own p-value is large, another candidate passed the surrogates
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
        tested_search,
        stretch if p_value > level else None,
    )


def _scene(
    base: FittedModel, fits: Sequence[FittedModel], terms: tuple[Term, ...], tangents: ModelTangents, settings: Settings
) -> tuple[FittedModel, SearchProblem]:
    """Return the best fit with finite tangents, and the linearised candidates, its own shape included."""
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
    return best, SearchProblem(base, around, terms, tangents, *_unmasked(around), settings)


def _unmasked(fit: FittedModel) -> tuple[Float[Tensor, "N m"], Float[Tensor, "N m"]]:
    """Return the residual and a mask that rejects only missing outputs."""
    mask = torch.ones_like(fit.residual) if fit.recorded is None else fit.recorded.to(fit.residual)
    return mask * fit.residual, mask


def _added(best: FittedModel, scene: SearchProblem) -> Float[Tensor, "N m"]:
    """Return what the effect of a fit adds to the residual."""
    if scene.around is scene.base:
        return best.residual - scene.base.residual
    number, gamma = scene.terms.index(best.model.terms[-1]), best.parameters[scene.base.model.size :]
    return torch.einsum("nmq,q->nm", scene.tangents.candidates[number], gamma)


def _shows(base: FittedModel, fit: FittedModel, settings: Settings) -> bool:
    """Whether a fit without an effect shows the effect fully: it rejects no more samples, and its scale is no larger.

    Then the effect is tested by tangents there. At a fit with the effect, a barely visible effect may have any size,
    such as a step while the sensor does not move, and the linearisation at that size does not hold at size 0.
    """
    least, search = settings.noise.rejected_below, settings.search
    rejected = (base.weights < least) & (fit.weights >= least)
    return float(rejected.double().mean()) < search.hidden and bool((fit.d > search.smaller * base.d).all())


def _judged(look: CandidateSearch, tried: int, surrogates: int, generator: torch.Generator) -> tuple[float, float]:
    """Apply :func:`surrogate_p_value` to the first ``tried`` candidates."""
    noise = look.settings.noise
    return surrogate_p_value(
        look.linearised, look.noise, look.gains, look.possible[:tried], surrogates, generator, noise
    )


class _NamedEffect(NamedTuple):
    """A named effect: the fit with it, and the search that distinguished it from others."""

    fit: FittedModel
    ranking: tuple[Ranked, ...]
    look: CandidateSearch


def _named(
    best: FittedModel, scene: SearchProblem, spectrum: NoiseSpectrum, prefer: ModelPrior, level: float
) -> _NamedEffect:
    """Name the effect under its remaining noise; whether there is an effect is tested under noise that includes it."""
    look, base, naming = scene.under(spectrum), scene.base, scene.settings.naming
    near = [scene.terms[place.number] for place in ranked(look, prefer) if place.gap < 2.0 * naming.separable]
    look = look.with_more(refine_candidates(near, look))
    terms, ranking = look.scene.terms, ranked(look, prefer)
    first, own = terms[ranking[0].number], best.model.terms[-1]
    nonlinear = any(scene.is_nonlinear(term) for term in (first, own))
    if first.key != own.key or look.own_p(own) > level:
        other = refitted(best, first, look, ranking[0].number)
        # a joint fit that loses much of the linear gain went beyond the linear range; but with a possible drift, joint
        # fits favour candidates that follow the drift, so the search decides if it separates the two candidates
        behind = [place.gap for place in ranking if terms[place.number].key == own.key]
        clear = scene.tangents.slow is not None and not (behind and behind[0] < naming.separable)
        least = 0.0 if clear else naming.kept * max(prefer.score(best, base), 0.0)
        gain = other.log_likelihood - base.log_likelihood if clear else prefer.score(other, base)
        if gain > least or (nonlinear and prefer.by_innovations(best, other) > 0.0):
            best = other
    return _NamedEffect(best, ranking, look)


def _with_tangents(
    fits: Sequence[FittedModel], terms: tuple[Term, ...], settings: Settings
) -> tuple[FittedModel, tuple[Term, ...], ModelTangents]:
    """Return the first fit that has finite tangents, the candidates with its own shape, and their tangents."""
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
    """Refit if the iteration did not converge, because a scale that is far too large can delay it."""
    if fit.converged:
        return fit
    again = fitted_with_effect(base, fit.model, fit.parameters, graduate=False)
    return again if again.log_likelihood > fit.log_likelihood else fit


def screening_p_value(
    located: SearchResult, possible: Sequence[bool], surrogates: int, generator: torch.Generator, *, quick: bool = False
) -> float:
    """Return the p-value of the strongest further candidate, in the linearisation of the search for an effect.

    Candidates, noise and mask are those of that search. The effect's tangents are projected out of everything, like
    those of the simulation's parameters. Nothing is refitted.

    Args:
        located: the effect.
        possible: whether each of its ``terms`` would be a further finding.
        surrogates: number of surrogates.
        generator: of the surrogates.
        quick: draw none; test whether a candidate gains more than its penalty.

    Returns:
        0 if an effect changes other samples' residuals too: there refits can find what the linearisation does not.
    """
    scene, own = located.scene, located.fit.model.terms[-1]
    if any(scene.is_nonlinear(term) for term in (*scene.terms, own)):
        return 0.0
    remaining = located.look.given(own, located.fit)
    mask = torch.tensor(list(possible)) & remaining.possible
    if not bool(mask.any()):
        return 1.0
    if quick:
        return any_pays(remaining, mask)
    noise = scene.settings.noise
    return surrogate_p_value(
        remaining.linearised, remaining.noise, remaining.gains, mask, surrogates, generator, noise
    )[0]
