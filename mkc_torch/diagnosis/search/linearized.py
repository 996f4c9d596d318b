"""What a search looks at: a fit, what candidates move there, and what of the residuals counts."""

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
    """The candidates beside a fit, where they are linear, and the residuals that they would have to explain.

    Attributes:
        base: the fit that the candidates stand beside.
        around: the fit that tangents are taken at: the same one, or one with a candidate in it.
        terms: the candidates.
        tangents: of the parameters of ``base`` and of the candidates.
        values, counts: (N, m), the pseudo-residual without a candidate, and what counts of it.
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
        """All that is large of it."""
        return (self.values, self.counts, *self.tangents.parts, *self._seen.parts)

    @cached_property
    def _seen(self) -> CosineProjection:
        """The same for noise of any colour."""
        return CosineProjection.of(self.values, self.counts, self.tangents, self.tangents.slow)

    def under(self, spectrum: NoiseSpectrum | None = None) -> LinearizedSearch:
        """The search of it under noise of a colour, default the likeliest one."""
        parameters = self.around.parameters[: self.base.model.size]
        found = linearise(
            self.base.model, parameters, self.values, self.counts, self.tangents, spectrum=spectrum, seen=self._seen
        )
        return LinearizedSearch(self, found)

    def without(self, stretch: tuple[int, int]) -> SearchProblem:
        """The same with nothing that counts from one sample to before another."""
        rest = self.counts.clone()
        rest[slice(*stretch)] = 0.0
        return replace(self, values=rest * self.values, counts=rest)

    def bends(self, term: Term) -> bool:
        """Whether an effect bends a trajectory, so that its tangents hold for small sizes alone."""
        return self.tangents.pointwise[term.port] is None

    def tangents_of(self, terms: Sequence[Term]) -> Sequence[Float[Tensor, "N m q"]]:
        """Those of other candidates."""
        return Candidates(self.around.model, self.around.parameters, terms, self.tangents.pointwise)


@dataclass(frozen=True)
class LinearizedSearch:
    """A scene and its search under noise of one colour.

    Attributes:
        scene: what is looked at.
        linearised: the search.
    """

    scene: SearchProblem
    linearised: LinearisedSearch

    @property
    def settings(self) -> Settings:
        """Those of the scene."""
        return self.scene.settings

    @cached_property
    def gains(self) -> SearchGains:
        """The likelihood ratio of each candidate."""
        return self.linearised.search.gains(self.linearised.series.unsqueeze(-1))

    @cached_property
    def noise(self) -> NoiseFit:
        """The wander of the noise without a candidate."""
        return self.linearised.search.noise_fit(self.linearised.series)

    @cached_property
    def possible(self) -> Bool[Tensor, " C"]:
        """Whether the amplitudes that fit have a sign that the physics allows."""
        possible = torch.ones(len(self.scene.terms), dtype=torch.bool)
        for number, term in enumerate(self.scene.terms):
            if term.effect.one_sided:
                possible[number] = bool((self.estimate(number) < 0).any())
        return possible

    def estimate(self, number: int) -> Float[Tensor, " q"]:
        """Minus γ of a candidate, by generalised least squares."""
        return self.linearised.search.estimate(number, self.linearised.series)[0]

    def gains_of(self, terms: Sequence[Term]) -> SearchGains:
        """The likelihood ratios of other candidates."""
        return self.linearised.gains_of(self.scene.tangents_of(terms), self.scene.counts)

    def with_more(self, terms: Sequence[Term]) -> LinearizedSearch:
        """The same with other candidates after its own."""
        beside, scene = self.scene.tangents_of(terms), self.scene
        tangents = replace(scene.tangents, candidates=one_after_the_other(scene.tangents.candidates, beside))
        more = replace(scene, terms=(*scene.terms, *terms), tangents=tangents)
        return LinearizedSearch(more, self.linearised.with_more(beside, scene.counts))

    def beside(self, term: Term, fit: FittedModel) -> LinearizedSearch:
        """The same with the tangents of a term taken out of everything, at a fit with it."""
        own = Candidates(fit.model, fit.parameters, [term], self.scene.tangents.pointwise)
        return LinearizedSearch(self.scene, self.linearised.without(own, self.scene.counts))

    def own_p(self, term: Term) -> float:
        """The p-value of a candidate, as if it were the only one."""
        return float(self.gains.log_p[self.scene.terms.index(term), 0].exp())
