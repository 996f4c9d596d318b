"""From a fitted model to a search: tangents of the parameters, of every candidate and of wandering noise, whitened."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._parallel.pool import shared
from mkc_torch.diagnosis.linearised.cosine_projection import FILLED_AT_ONCE, CosineProjection, each
from mkc_torch.diagnosis.linearised.linear_search import LinearSearch, SearchGains
from mkc_torch.diagnosis.linearised.tangents import ModelTangents, SlowBasis
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.noise.cosine_basis import dct
from mkc_torch.diagnosis.noise.imputation import Imputation
from mkc_torch.diagnosis.noise.spectrum import (
    NoiseSpectrum,
    autoregressive,
    colour_of,
    colour_of_fast,
    enters_at_port,
    port_colour,
)

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["LinearisedSearch", "linearise"]


_ALTERNATIONS, _SETTLED = 8, 10.0
"""Steps at most between the colour and a wander beside it, and the nats that a step has to bring: as many as a colour,
which is some twenty numbers, gains by chance."""

_REACHED = 0.98
"""Share of a random walk's power that lies at the frequencies that it reaches."""

_FARTHEST = 10.0
"""Times that a step may go beyond, of the root of a spectrum."""

_REFILLED = 2
"""Times that the colour is read again, with what it says of rejected samples."""


@dataclass(frozen=True)
class LinearisedSearch:
    """A search and the series it is about.

    Attributes:
        search: over the candidates.
        series: (M,), the whitened pseudo-residual, and what the prior pulls at.
        colour: of the stationary part of the noise.
        entrance: where wandering noise enters, coloured noise may too: the port's pointwise tangents, and the
            autoregression of noise that gives such residuals; None where there is no such port.
        filling: what stands in for rejected samples.
        others: noise from where the alternation between colour and wander was not begun.
    """

    search: LinearSearch
    series: Float[Tensor, " M"]
    spectrum: NoiseSpectrum
    entrance: tuple[Tensor, Tensor] | None
    filling: Imputation
    others: tuple[LinearisedSearch, ...] = ()

    def plausible(self, within: float) -> list[NoiseSpectrum]:
        """Other colours that the noise may have: as likely ones, within some nats.

        The alternation comes to them from elsewhere: a spectrum of twenty numbers that a wander hides in part has
        several.
        """
        settled = [_settled(one) for one in self.others]
        return [one.spectrum for one in settled if one.evidence > self.evidence - within]

    def colour_beside(self) -> NoiseSpectrum:
        """The colour of what is left beside the wander."""
        K, m = self.spectrum.root.shape
        power = self.search.stationary(self.series)[: K * m].unflatten(0, (K, m))
        return colour_of(power * self.spectrum.root.square())

    @property
    def wanders(self) -> bool:
        """Whether a wander makes the noise likelier."""
        return self.search.noise_fit(self.series).gain > 0

    def colour_ahead(self) -> NoiseSpectrum:
        """Twice as far from the present colour as :meth:`colour_beside`: that goes slowly where a wander is strong.

        Salakhutdinov & Roweis, "Adaptive overrelaxed bound optimization methods", ICML (2003).
        """
        step = self.colour_beside()
        beyond = (step.root / self.spectrum.root).clamp(1.0 / _FARTHEST, _FARTHEST)
        return replace(step, root=step.root * beyond)

    def recoloured(self, spectrum: NoiseSpectrum) -> LinearisedSearch:
        """The same beside noise of another colour, with what stands in for rejected samples as it is."""
        factor = (self.spectrum.root / spectrum.root).flatten()
        own, rows = self.series[: len(factor)], len(self.series) - len(factor)
        # what the prior pulls at is on the scale of the residuals
        scale = (factor * own).std() / own.std()
        factor = torch.cat([factor, scale.expand(rows)])
        return replace(self, search=self.search.scaled(factor), series=factor * self.series, spectrum=spectrum)

    @property
    def evidence(self) -> float:
        """Log-likelihood of the residuals by their own noise, up to a constant that all noise of a recording shares."""
        log_det = float(self.spectrum.root.log().sum()) + 0.5 * self.filling.log_det
        return self.search.noise_fit(self.series).log_likelihood - log_det

    def gains_of(self, tangents: Sequence[Float[Tensor, "N m q"]], counts: Float[Tensor, "N m"]) -> SearchGains:
        """The likelihood ratios of other candidates on the series."""
        return self.search.with_candidates(self._columns(tangents, counts)).gains(self.series.unsqueeze(-1))

    def with_more(self, tangents: Sequence[Float[Tensor, "N m q"]], counts: Float[Tensor, "N m"]) -> LinearisedSearch:
        """The same with other candidates after its own."""
        return replace(self, search=self.search.with_more(self._columns(tangents, counts)))

    def without(self, tangents: Sequence[Float[Tensor, "N m q"]], counts: Float[Tensor, "N m"]) -> LinearisedSearch:
        """The same with these tangents taken out of everything too."""
        return replace(self, search=self.search.without(torch.cat(self._columns(tangents, counts), -1)))

    def _columns(self, tangents: Sequence[Float[Tensor, "N m q"]], counts: Float[Tensor, "N m"]) -> list[Tensor]:
        rows = len(self.series) - self.spectrum.root.numel()
        columns = each(lambda joined: self._whitened(counts.unsqueeze(-1) * joined), tangents)
        return [torch.cat([c, c.new_zeros(rows, c.shape[1])]) for c in columns]

    def _whitened(self, values: Float[Tensor, "N m c"]) -> Float[Tensor, "Km c"]:
        return self.spectrum.scaled(self.filling(dct(values, len(self.spectrum.root))))

    def entering(self, count: int, generator: torch.Generator) -> Float[Tensor, "M B"] | None:
        """Draws of coloured noise that enters at the port, of variance one once whitened."""
        if self.entrance is None:
            return None
        pointwise, coefficients = self.entrance
        N, _, channels = pointwise.shape
        drawn = autoregressive(coefficients, N, channels * count, generator).reshape(N, channels, count)
        flat = self._whitened(torch.einsum("nmc,ncb->nmb", pointwise, drawn))
        rows = len(self.series) - len(flat)
        prior = torch.randn(rows, count, generator=generator, dtype=flat.dtype)
        # the colour knows how much there is at each frequency; the draws know how frequencies hang together
        return torch.cat([flat / flat.square().mean(-1, keepdim=True).sqrt().clamp(min=1e-300), prior])


def linearise(
    model: JointModel,
    parameters: Float[Tensor, " p"],
    pseudo: Float[Tensor, "N m"],
    counts: Float[Tensor, "N m"],
    tangents: ModelTangents,
    *,
    spectrum: NoiseSpectrum | None = None,
    near: NoiseSpectrum | None = None,
    white: bool = False,
    drift: bool = True,
    joint: bool = False,
    seen: CosineProjection | None = None,
) -> LinearisedSearch:
    """A search around a fit.

    Args:
        model, parameters: the fit.
        pseudo: its pseudo-residual, without the effect that is sought.
        counts: 0 where a residual was rejected; there the tangents say nothing either.
        tangents: at the fit.
        colour: of the noise; default the likeliest one of ``pseudo``.
        near: a colour that is close to it.
        white: beside the wander, noise counts as white.
        wander: allow for noise that wanders at the ports.
        joint: the one candidate is all of the parameters, to be estimated together.
        seen: what :meth:`CosineProjection.of` gives of the same, where it is known.
    """
    m = pseudo.shape[1]
    pull = _Pull.of(model, parameters)
    slow = tangents.slow if drift else None
    seen = CosineProjection.of(pseudo, counts, tangents, slow) if seen is None else seen
    level = pseudo.new_ones(seen.kept, m) * _level(pseudo)
    plain = NoiseSpectrum(tuple(pseudo.new_zeros(0) for _ in range(m)), level)
    if white:
        return _searching(plain, pull, seen, slow)
    bare = replace(seen, candidates=())
    if joint:
        own = _coloured(plain, near, pull, bare, slow).spectrum if spectrum is None else spectrum
        return _searching(own, pull, seen, slow, joint=True)
    found = _coloured(plain, near, pull, bare, slow) if spectrum is None else _searching(spectrum, pull, bare, slow)
    candidates = [
        pull.below(found.spectrum.scaled(one)) for one in each(found.filling, seen.candidates, FILLED_AT_ONCE)
    ]
    found = replace(found, search=found.search.with_candidates(candidates))
    pointwise = None if slow is None else tangents.pointwise[slow.port]
    if slow is None or pointwise is None or not tangents.candidates:
        return found
    block = counts.unsqueeze(-1) * pointwise
    # the wander is drawn for itself
    beside = pseudo - counts * slow.waveform(found.search.courses(found.series))
    if not enters_at_port(beside, block):
        return found
    return replace(found, entrance=(block, port_colour(beside, block)))


def _searching(
    spectrum: NoiseSpectrum, pull: _Pull, seen: CosineProjection, slow: SlowBasis | None, *, joint: bool = False
) -> LinearisedSearch:
    """A search of what has its rejected samples filled."""
    filling = seen.gaps.filling(spectrum)
    seen = seen.filled(filling)
    flat = spectrum.scaled(seen.pseudo)
    parameters = pull.under(spectrum.scaled(seen.nuisance), flat)
    candidates = [pull.below(spectrum.scaled(one)) for one in seen.candidates]
    search = LinearSearch(
        parameters[:, :0] if joint else parameters,
        [parameters] if joint else candidates,
        pull.below(spectrum.scaled(seen.slow)),
        flat.new_zeros(0, 0) if slow is None else slow.scales,
        0.0 if slow is None else slow.walk_first,
    )
    return LinearisedSearch(search, pull.beside(flat), spectrum, None, filling)


def _coloured(
    plain: NoiseSpectrum, near: NoiseSpectrum | None, pull: _Pull, seen: CosineProjection, slow: SlowBasis | None
) -> LinearisedSearch:
    """With the likeliest colour of the noise beside a wander at the port, by alternating between the two."""
    alone = replace(seen, slow=seen.slow[..., :0])

    def beside_nothing() -> NoiseSpectrum:
        best = _searching(plain, pull, alone, None).colour_beside()
        for _ in range(_REFILLED):
            found = _searching(best, pull, alone, None)
            if found.filling.nothing:
                break
            best = found.colour_beside()
        return best

    if slow is None:
        return _searching(beside_nothing(), pull, seen, None)

    def beside_wander() -> NoiseSpectrum:
        return _searching(plain, pull, seen, slow).colour_beside() if near is None else near

    def tried(spectrum: Callable[[], NoiseSpectrum]) -> LinearisedSearch:
        return _searching(spectrum(), pull, seen, slow)

    def beyond_wander() -> NoiseSpectrum:
        spread = (seen.slow.square() * slow.scales[0].square()).sum(-1)
        return colour_of_fast(seen.pseudo.square(), ((spread.cumsum(0) / spread.sum(0)) < _REACHED).sum(0))

    # from the side of no wander, from that of no colour, and from where there is no wander: each could pass for another
    colours = (beside_nothing, beside_wander, beyond_wander)
    starts = shared([partial(tried, spectrum) for spectrum in colours], [slow, slow.tangents, slow.scales])
    best = max(starts, key=lambda found: found.evidence)
    return replace(_settled(best), others=tuple(one for one in starts if one is not best))


def _settled(found: LinearisedSearch) -> LinearisedSearch:
    """With the colour that alternating between it and the wander comes to.

    What stands in for rejected samples stays: it follows any colour, and would lead it on. The family of the wander
    stays too until the colour has settled, and is asked for again then: each is decomposed anew for every colour.
    """
    tried: set[int] = set()
    while (drift := found.search.noise_fit(found.series)).gain > 0 and drift.family not in tried:
        tried.add(drift.family)
        found = _settled_in(replace(found, search=found.search.of_family(drift.family)))
        found = replace(found, search=found.search.of_family(None))
    return found


def _settled_in(found: LinearisedSearch) -> LinearisedSearch:
    for _ in range(_ALTERNATIONS):
        step = found.recoloured(found.colour_ahead())
        if step.evidence <= found.evidence + _SETTLED:
            # it may have gone too far, as the one that cannot has not
            step = max(step, found.recoloured(found.colour_beside()), key=lambda one: one.evidence)
        if step.evidence <= found.evidence + _SETTLED:
            break
        found = step
    return found


def _level(pseudo: Tensor) -> Tensor:
    """Root mean square of each channel: noisy channels count for less from the start."""
    return pseudo.square().mean(0).sqrt().clamp(min=1e-300)


@dataclass(frozen=True)
class _Pull:
    """A Gaussian prior as rows below the whitened residuals."""

    root: Tensor  # (r, p)
    distance: Tensor  # (r,)

    @classmethod
    def of(cls, model: JointModel, parameters: Tensor) -> _Pull:
        prior = model.prior
        if prior is None:
            return cls(parameters.new_zeros(0, len(parameters)), parameters.new_zeros(0))
        precision = prior.precision if prior.precision.dim() == 2 else torch.diag(prior.precision)
        values, vectors = torch.linalg.eigh(precision)
        known = values > 0
        root = values[known].sqrt().unsqueeze(-1) * vectors[:, known].mT
        return cls(root, root @ (parameters - prior.mean))

    def under(self, nuisance: Tensor, flat: Tensor) -> Tensor:
        """The parameters' tangents, with rows on the scale of the residuals."""
        return torch.cat([nuisance, flat.std() * self.root])

    def below(self, columns: Tensor) -> Tensor:
        """Other tangents: the prior does not know of them."""
        return torch.cat([columns, columns.new_zeros(len(self.distance), columns.shape[-1])])

    def beside(self, flat: Tensor) -> Tensor:
        return torch.cat([flat, flat.std() * self.distance])
