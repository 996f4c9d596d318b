"""The linearised search problem at a fit, and the refinement of candidates' shapes between the points of the grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.model.fit import FittedModel, fitted_with_effect
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import finer
from mkc_torch.diagnosis.model.term import Term, continuous
from mkc_torch.diagnosis.noise.drift import NoiseFit
from mkc_torch.diagnosis.noise.spectrum import NoiseSpectrum
from mkc_torch.diagnosis.search.linear_search import SearchGains
from mkc_torch.diagnosis.search.linearise import CosineProjection, LinearisedSearch, linearise
from mkc_torch.diagnosis.search.tangents import Candidates, ModelTangents, one_after_the_other
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.functional import mkc_energy

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


@dataclass(frozen=True)
class SearchProblem:
    """The linearised candidates at a fit, and the residuals that they would have to explain.

    Attributes:
        base: the fit that candidates are added to.
        around: the fit at which tangents are taken: ``base``, or a fit with a candidate.
        terms: the candidates.
        tangents: of the parameters of ``base`` and of the candidates.
        values, counts: (N, m), the pseudo-residual without a candidate, and its mask.
        settings: of the search.
    """

    base: FittedModel
    around: FittedModel
    terms: tuple[Term, ...]
    tangents: ModelTangents
    values: Float[Tensor, "N m"]
    counts: Float[Tensor, "N m"]
    settings: Settings

    @cached_property
    def _seen(self) -> CosineProjection:
        """The projection to the cosine basis, for noise of any spectrum."""
        return CosineProjection.of(self.values, self.counts, self.tangents, self.tangents.slow)

    def under(self, spectrum: NoiseSpectrum | None = None) -> CandidateSearch:
        """Return the search under noise of a spectrum, by default the most likely."""
        parameters = self.around.parameters[: self.base.model.size]
        found = linearise(
            self.base.model, parameters, self.values, self.counts, self.tangents, spectrum=spectrum, seen=self._seen
        )
        return CandidateSearch(self, found)

    def without(self, stretch: tuple[int, int]) -> SearchProblem:
        """Return the problem with a stretch of samples masked."""
        rest = self.counts.clone()
        rest[slice(*stretch)] = 0.0
        return replace(self, values=rest * self.values, counts=rest)

    def is_nonlinear(self, term: Term) -> bool:
        """Whether an effect changes other samples' residuals too, so that its tangents hold for small sizes only."""
        return self.tangents.pointwise[term.port] is None

    def tangents_of(self, terms: Sequence[Term]) -> Sequence[Float[Tensor, "N m q"]]:
        """Return the tangents of other candidates."""
        return Candidates(self.around.model, self.around.parameters, terms, self.tangents.pointwise)


@dataclass(frozen=True)
class CandidateSearch:
    """A search problem and its search under one noise spectrum.

    Attributes:
        scene: the problem.
        linearised: the search.
    """

    scene: SearchProblem
    linearised: LinearisedSearch

    @property
    def settings(self) -> Settings:
        """Settings of the problem."""
        return self.scene.settings

    @cached_property
    def gains(self) -> SearchGains:
        """The likelihood ratio of each candidate."""
        return self.linearised.search.gains(self.linearised.series.unsqueeze(-1))

    @cached_property
    def noise(self) -> NoiseFit:
        """The drift of the noise without a candidate."""
        return self.linearised.search.noise_fit(self.linearised.series)

    @cached_property
    def possible(self) -> Bool[Tensor, " C"]:
        """Whether the fitted sizes have a sign that the physics allows, (C,)."""
        possible = torch.ones(len(self.scene.terms), dtype=torch.bool)
        for number, term in enumerate(self.scene.terms):
            if term.effect.one_sided:
                possible[number] = bool((self.estimate(number) < 0).any())
        return possible

    def estimate(self, number: int) -> Float[Tensor, " q"]:
        """Return minus γ of a candidate, by generalised least squares."""
        return self.linearised.search.estimate(number, self.linearised.series)[0]

    def gains_of(self, terms: Sequence[Term]) -> SearchGains:
        """Return the likelihood ratios of other candidates."""
        return self.linearised.gains_of(self.scene.tangents_of(terms), self.scene.counts)

    def with_more(self, terms: Sequence[Term]) -> CandidateSearch:
        """Return the search with these candidates after its own."""
        added, scene = self.scene.tangents_of(terms), self.scene
        tangents = replace(scene.tangents, candidates=one_after_the_other(scene.tangents.candidates, added))
        more = replace(scene, terms=(*scene.terms, *terms), tangents=tangents)
        return CandidateSearch(more, self.linearised.with_more(added, scene.counts))

    def given(self, term: Term, fit: FittedModel) -> CandidateSearch:
        """Return the search with the tangents of a term, at a fit with it, projected out of everything."""
        own = Candidates(fit.model, fit.parameters, [term], self.scene.tangents.pointwise)
        return CandidateSearch(self.scene, self.linearised.without(own, self.scene.counts))

    def own_p(self, term: Term) -> float:
        """Return the p-value of a candidate as if it were the only candidate."""
        return float(self.gains.log_p[self.scene.terms.index(term), 0].exp())


_ROUNDS = 3
"""Rounds of narrowing the range of a shape number."""


def refined(best: FittedModel, base: FittedModel, *, again: bool = False) -> FittedModel:
    """Return the fit with its continuous shape numbers refined one by one.

    Args:
        best: the fit.
        base: the fit without its last effect.
        again: repeat from there, with the sizes fitted to the new shape.
    """
    term = best.model.terms[-1]
    names = continuous(term)
    if not names:
        return best
    for count in range(_ROUNDS):
        for name in names:
            shapes = finer(term, name, base.model.prepared.time, count)
            value = [_energy(best, best.model.with_last(shape)) for shape in shapes]
            term = shapes[min(range(len(shapes)), key=value.__getitem__)]
    moved = fitted_with_effect(base, best.model.with_last(term), best.parameters, graduate=False)
    if not moved.log_likelihood > best.log_likelihood:
        return best
    return refined(moved, base) if again else moved


def refine_candidates(terms: Sequence[Term], look: CandidateSearch) -> tuple[Term, ...]:
    """Return candidates with their continuous shape numbers refined under the noise of the search.

    Only at pointwise ports: elsewhere each shape needs a new trajectory.
    """
    refine_candidates = []
    for term in terms:
        names = continuous(term)
        if not names or look.scene.is_nonlinear(term):
            continue
        found = term
        for count in range(_ROUNDS):
            for name in names:
                shapes = finer(found, name, look.scene.base.model.prepared.time, count)
                found = shapes[int(look.gains_of(shapes).ratio[:, 0].argmax())]
        if found.shape != term.shape:
            refine_candidates.append(found)
    return tuple(refine_candidates)


def with_spectrum(best: FittedModel, look: CandidateSearch) -> FittedModel:
    """Return the fit with the shape that is most likely under the noise of the search; a joint fit assumes white noise.

    Another shape is taken if it is clearly better; otherwise the middle of the equivalent shapes, such as all onsets
    within a burst of rejected samples.
    """
    own, base, naming = best.model.terms[-1], look.scene.base, look.settings.naming
    names = continuous(own)
    if not names or look.scene.is_nonlinear(own):
        return best

    def gains(terms: Sequence[Term]) -> list[float]:
        return look.gains_of(terms).ratio[:, 0].tolist()

    others = refine_candidates([own], look)
    here, *there = gains([own, *others])
    if there and there[0] > here + naming.shape_clear:
        moved = others[0]
    else:
        moved = own
        for name in names * _ROUNDS:
            shapes = finer(moved, name, base.model.prepared.time, 1)
            place = [shape.shape for shape in shapes].index(moved.shape)
            moved = shapes[middle(gains(shapes), place, naming.shape_alike)]
    if moved.shape == own.shape:
        return best
    fit = fitted_with_effect(base, best.model.with_shape(moved.shape), best.parameters, graduate=False)
    return fit if fit.converged else best


def middle(values: Sequence[float], place: int, alike: float) -> int:
    """Return the middle of the neighbours of a place whose values differ from it by less than ``alike``.

    Example:
        >>> middle([1.0, 7.0, 7.2, 7.1, 7.0, 7.2, 2.0, 7.2], 1, 0.5)
        3
    """
    first = last = place
    while first > 0 and abs(values[first - 1] - values[place]) < alike:
        first -= 1
    while last < len(values) - 1 and abs(values[last + 1] - values[place]) < alike:
        last += 1
    return (first + last) // 2


def _energy(fit: FittedModel, model: JointModel) -> float:
    """Return the energy of another shape, at the same parameters."""
    return float(mkc_energy(model.residual(fit.parameters), fit.sigma, fit.d).sum())
