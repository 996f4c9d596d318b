"""The linearised search problem: a fit, the tangents of the candidates, and the mask of the residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.linearised.candidates import Candidates, one_after_the_other
from mkc_torch.diagnosis.linearised.cosine_projection import CosineProjection
from mkc_torch.diagnosis.linearised.drift import NoiseFit
from mkc_torch.diagnosis.linearised.linear_search import SearchGains
from mkc_torch.diagnosis.linearised.linearise import LinearisedSearch, linearise
from mkc_torch.diagnosis.linearised.tangents import ModelTangents
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.noise.spectrum import NoiseSpectrum
from mkc_torch.diagnosis.settings import Settings

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["LinearizedSearch", "SearchProblem"]


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

    @property
    def parts(self) -> tuple[object, ...]:
        """All large parts."""
        return (self.values, self.counts, *self.tangents.parts, *self._seen.parts)

    @cached_property
    def _seen(self) -> CosineProjection:
        """The projection to the cosine basis, for noise of any spectrum."""
        return CosineProjection.of(self.values, self.counts, self.tangents, self.tangents.slow)

    def under(self, spectrum: NoiseSpectrum | None = None) -> LinearizedSearch:
        """Return the search under noise of a spectrum, by default the most likely."""
        parameters = self.around.parameters[: self.base.model.size]
        found = linearise(
            self.base.model, parameters, self.values, self.counts, self.tangents, spectrum=spectrum, seen=self._seen
        )
        return LinearizedSearch(self, found)

    def without(self, stretch: tuple[int, int]) -> SearchProblem:
        """Return the problem with a stretch of samples masked."""
        rest = self.counts.clone()
        rest[slice(*stretch)] = 0.0
        return replace(self, values=rest * self.values, counts=rest)

    def is_nonlinear(self, term: Term) -> bool:
        """Whether an effect acts through a trajectory, so that its tangents hold for small sizes only."""
        return self.tangents.pointwise[term.port] is None

    def tangents_of(self, terms: Sequence[Term]) -> Sequence[Float[Tensor, "N m q"]]:
        """Return the tangents of other candidates."""
        return Candidates(self.around.model, self.around.parameters, terms, self.tangents.pointwise)


@dataclass(frozen=True)
class LinearizedSearch:
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

    def with_more(self, terms: Sequence[Term]) -> LinearizedSearch:
        """Return the search with these candidates after its own."""
        added, scene = self.scene.tangents_of(terms), self.scene
        tangents = replace(scene.tangents, candidates=one_after_the_other(scene.tangents.candidates, added))
        more = replace(scene, terms=(*scene.terms, *terms), tangents=tangents)
        return LinearizedSearch(more, self.linearised.with_more(added, scene.counts))

    def given(self, term: Term, fit: FittedModel) -> LinearizedSearch:
        """Return the search with the tangents of a term, at a fit with it, projected out of everything."""
        own = Candidates(fit.model, fit.parameters, [term], self.scene.tangents.pointwise)
        return LinearizedSearch(self.scene, self.linearised.without(own, self.scene.counts))

    def own_p(self, term: Term) -> float:
        """Return the p-value of a candidate as if it were the only candidate."""
        return float(self.gains.log_p[self.scene.terms.index(term), 0].exp())
