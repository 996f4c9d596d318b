"""The linearised search under coloured noise: projection to the cosine basis, whitening, and the gains there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._parallel.pool import shared
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.noise.imputation import Imputation, MissingSamples
from mkc_torch.diagnosis.noise.spectrum import (
    NoiseSpectrum,
    autoregressive,
    dct,
    enters_at_port,
    port_autoregression,
    spectrum_of,
    spectrum_of_fast,
)
from mkc_torch.diagnosis.search.linear_search import LinearSearch, SearchGains
from mkc_torch.diagnosis.search.tangents import AT_ONCE, ModelTangents, SlowBasis, in_blocks

if TYPE_CHECKING:
    from jaxtyping import Float

_MOST = 0.9
"""Share of the tangents' power that sets their bandwidth."""

_MARGIN = 3.0
"""Number of cosine coefficients that are kept, in multiples of that bandwidth."""

_FEWEST = 1000
"""Smallest number of cosine coefficients that are kept."""

FILLED_AT_ONCE = 64
"""Candidates whose coefficients are imputed together: each block reads a large matrix once and fits into the cache."""


@dataclass(frozen=True)
class CosineProjection:
    """Residual and tangents at the samples that count, in their K slowest coefficients.

    Attributes:
        pseudo: the pseudo-residual.
        nuisance, candidates, slow: tangents of the simulation's own parameters, of each candidate, and of the slow
            cosines of a drift.
        gaps: the rejected samples.
    """

    pseudo: Float[Tensor, "K m"]
    nuisance: Float[Tensor, "K m p"]
    candidates: tuple[Float[Tensor, "K m q"], ...]
    slow: Float[Tensor, "K m k"]
    gaps: MissingSamples

    @classmethod
    def of(
        cls,
        pseudo: Float[Tensor, "N m"],
        counts: Float[Tensor, "N m"],
        tangents: ModelTangents,
        slow: SlowBasis | None,
        spectrum: NoiseSpectrum | None = None,
    ) -> CosineProjection:
        """Project all samples; candidates are processed a few at a time, and only their coefficients are kept.

        Args:
            pseudo, counts, tangents: of all samples.
            slow: the drift's cosines; None without a drift.
            spectrum: a known spectrum, whose K is used; None for K by the bandwidth of the parameters' tangents.
        """
        # a spectrum known from fewer parameters has the K of their tangents, which can be another
        kept = _bandwidth(tangents.nuisance) if spectrum is None else len(spectrum.root)

        def moved(joined: Tensor) -> Tensor:
            return dct(counts.unsqueeze(-1) * joined, kept)

        nuisance = moved(tangents.nuisance)
        candidates = each(moved, tangents.candidates)
        courses = nuisance[..., :0] if slow is None else slow.transformed(counts, kept)
        return cls(dct(pseudo, kept), nuisance, tuple(candidates), courses, MissingSamples(counts, kept))

    @property
    def kept(self) -> int:
        """K."""
        return len(self.pseudo)

    def filled(self, filling: Imputation) -> CosineProjection:
        """Impute the expected noise at rejected samples, in residual and tangents alike."""
        pseudo, nuisance, *candidates = each(
            filling, [self.pseudo.unsqueeze(-1), self.nuisance, *self.candidates], FILLED_AT_ONCE
        )
        return replace(
            self,
            pseudo=pseudo.squeeze(-1),
            nuisance=nuisance,
            candidates=tuple(candidates),
            slow=filling(self.slow),
        )


def each(function: Callable[[Tensor], Tensor], columns: Sequence[Tensor], at_once: int = AT_ONCE) -> list[Tensor]:
    """Apply a function of columns to each of these matrices, a few of them at a time.

    Example:
        >>> columns = [torch.ones(2, 1), torch.ones(2, 3)]
        >>> [doubled.shape[-1] for doubled in each(lambda joined: 2.0 * joined, columns)]
        [1, 3]
    """
    return [
        done
        for block in in_blocks(columns, at_once)
        for done in function(torch.cat([*block], -1)).split([c.shape[-1] for c in block], -1)
    ]


def _bandwidth(nuisance: Float[Tensor, "N m p"]) -> int:
    """Return how many slow cosine coefficients to keep: three times as many as hold 90 % of the tangents' power."""
    N = len(nuisance)
    power = dct(nuisance).square().sum(1)
    share = (power / power.sum(0).clamp(min=1e-300)).cumsum(0)
    typical = (share < _MOST).sum(0).double().median()
    return int(min(N, max(_FEWEST, _MARGIN * float(typical))))


_ALTERNATIONS = 8
"""Largest number of alternations between spectrum and drift."""

_SETTLED = 10.0
"""Nats that an alternation has to gain to continue: as many as a spectrum of about twenty numbers gains by chance."""

_REACHED = 0.98
"""Share of a random walk's power below the frequency from which the spectrum is estimated without the drift."""

_FARTHEST = 10.0
"""Largest factor by which an over-relaxed step may change the root of a spectrum."""

_REFILLED = 2
"""Rounds of estimating the spectrum and imputing rejected samples with it."""


@dataclass(frozen=True)
class LinearisedSearch:
    """A linear search and its series.

    Attributes:
        search: over the candidates.
        series: (M,), the whitened pseudo-residual, followed by the prior's rows.
        spectrum: of the stationary part of the noise.
        entrance: if coloured noise enters at the drift's port: the port's pointwise tangents, and the autoregression of
            the noise there; otherwise None.
        filling: imputation of the rejected samples.
        others: noise models from the other starts of the alternation between spectrum and drift.
    """

    search: LinearSearch
    series: Float[Tensor, " M"]
    spectrum: NoiseSpectrum
    entrance: tuple[Tensor, Tensor] | None
    filling: Imputation
    others: tuple[LinearisedSearch, ...] = ()

    def plausible(self, within: float) -> list[NoiseSpectrum]:
        """Return other spectra of the noise that are within some nats of the most likely.

        They are the results of the alternation from other starts: a spectrum of twenty numbers that a drift partly
        hides has several optima.
        """
        settled = [_settled(start) for start in self.others]
        return [found.spectrum for found in settled if found.evidence > self.evidence - within]

    def stationary_spectrum(self) -> NoiseSpectrum:
        """Return the spectrum of the noise without the drift."""
        K, m = self.spectrum.root.shape
        power = self.search.stationary(self.series)[: K * m].unflatten(0, (K, m))
        return spectrum_of(power * self.spectrum.root.square())

    @property
    def has_drift(self) -> bool:
        """Whether a drift makes the noise more likely."""
        return self.search.noise_fit(self.series).gain > 0

    def overrelaxed_spectrum(self) -> NoiseSpectrum:
        """Return twice the step of :meth:`stationary_spectrum` (over-relaxation), which is slow for a strong drift.

        Salakhutdinov & Roweis, "Adaptive overrelaxed bound optimization methods", ICML (2003).
        """
        step = self.stationary_spectrum()
        beyond = (step.root / self.spectrum.root).clamp(1.0 / _FARTHEST, _FARTHEST)
        return replace(step, root=step.root * beyond)

    def under(self, spectrum: NoiseSpectrum) -> LinearisedSearch:
        """Return the search under another noise spectrum, with the same imputation of rejected samples."""
        factor = (self.spectrum.root / spectrum.root).flatten()
        own, rows = self.series[: len(factor)], len(self.series) - len(factor)
        # the prior's rows are on the scale of the residuals
        scale = (factor * own).std() / own.std()
        factor = torch.cat([factor, scale.expand(rows)])
        return replace(self, search=self.search.scaled(factor), series=factor * self.series, spectrum=spectrum)

    @property
    def evidence(self) -> float:
        """Log-likelihood of the residuals under their noise, up to a constant of the recording."""
        log_det = float(self.spectrum.root.log().sum()) + 0.5 * self.filling.log_det
        return self.search.noise_fit(self.series).log_likelihood - log_det

    def gains_of(self, tangents: Sequence[Float[Tensor, "N m q"]], counts: Float[Tensor, "N m"]) -> SearchGains:
        """Return the likelihood ratios of other candidates on the series."""
        return self.search.with_candidates(self._columns(tangents, counts)).gains(self.series.unsqueeze(-1))

    def with_more(self, tangents: Sequence[Float[Tensor, "N m q"]], counts: Float[Tensor, "N m"]) -> LinearisedSearch:
        """Return the search with these candidates after its own."""
        return replace(self, search=self.search.with_more(self._columns(tangents, counts)))

    def without(self, tangents: Sequence[Float[Tensor, "N m q"]], counts: Float[Tensor, "N m"]) -> LinearisedSearch:
        """Return the search with these tangents projected out of everything too."""
        return replace(self, search=self.search.without(torch.cat(self._columns(tangents, counts), -1)))

    def _columns(self, tangents: Sequence[Float[Tensor, "N m q"]], counts: Float[Tensor, "N m"]) -> list[Tensor]:
        rows = len(self.series) - self.spectrum.root.numel()
        columns = each(lambda joined: self._whitened(counts.unsqueeze(-1) * joined), tangents)
        return [torch.cat([c, c.new_zeros(rows, c.shape[1])]) for c in columns]

    def _whitened(self, values: Float[Tensor, "N m c"]) -> Float[Tensor, "Km c"]:
        return self.spectrum.scaled(self.filling(dct(values, len(self.spectrum.root))))

    def entering(self, count: int, generator: torch.Generator) -> Float[Tensor, "M B"] | None:
        """Draw coloured noise that enters at the port, with variance 1 once whitened; None without such a port."""
        if self.entrance is None:
            return None
        pointwise, coefficients = self.entrance
        N, _, channels = pointwise.shape
        drawn = autoregressive(coefficients, N, channels * count, generator).reshape(N, channels, count)
        flat = self._whitened(torch.einsum("nmc,ncb->nmb", pointwise, drawn))
        rows = len(self.series) - len(flat)
        prior = torch.randn(rows, count, generator=generator, dtype=flat.dtype)
        # the spectrum sets the power at each frequency, the draws the correlation between frequencies
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
    """Linearise a model at a fit.

    Args:
        model, parameters: the fit.
        pseudo: its pseudo-residual, without the effect that is sought.
        counts: 0 for a rejected residual; there the tangents are ignored too.
        tangents: at the fit.
        spectrum: of the noise; default the most likely spectrum of ``pseudo``.
        near: a similar spectrum, as the start.
        white: treat noise other than the drift as white.
        drift: allow for a drift at the ports.
        joint: the only candidate is the vector of all parameters, to be estimated together.
        seen: result of :meth:`CosineProjection.of` for the same arguments and the same K, if known.
    """
    m = pseudo.shape[1]
    prior_rows = _PriorRows.of(model, parameters)
    slow = tangents.slow if drift else None
    known = near if spectrum is None else spectrum
    seen = CosineProjection.of(pseudo, counts, tangents, slow, known) if seen is None else seen
    level = pseudo.new_ones(seen.kept, m) * _level(pseudo)
    plain = NoiseSpectrum(tuple(pseudo.new_zeros(0) for _ in range(m)), level)
    if white:
        return _build_search(plain, prior_rows, seen, slow)
    bare = replace(seen, candidates=())
    if joint:
        own = _with_own_spectrum(plain, near, prior_rows, bare, slow).spectrum if spectrum is None else spectrum
        return _build_search(own, prior_rows, seen, slow, joint=True)
    found = (
        _with_own_spectrum(plain, near, prior_rows, bare, slow)
        if spectrum is None
        else _build_search(spectrum, prior_rows, bare, slow)
    )
    candidates = [
        prior_rows.below(found.spectrum.scaled(c)) for c in each(found.filling, seen.candidates, FILLED_AT_ONCE)
    ]
    found = replace(found, search=found.search.with_candidates(candidates))
    pointwise = None if slow is None else tangents.pointwise[slow.port]
    if slow is None or pointwise is None or not tangents.candidates:
        return found
    block = counts.unsqueeze(-1) * pointwise
    # the drift is drawn separately
    without_drift = pseudo - counts * slow.waveform(found.search.courses(found.series))
    if not enters_at_port(without_drift, block):
        return found
    return replace(found, entrance=(block, port_autoregression(without_drift, block)))


def _build_search(
    spectrum: NoiseSpectrum,
    prior_rows: _PriorRows,
    seen: CosineProjection,
    slow: SlowBasis | None,
    *,
    joint: bool = False,
) -> LinearisedSearch:
    """Build the search with the rejected samples imputed."""
    filling = seen.gaps.filling(spectrum)
    seen = seen.filled(filling)
    flat = spectrum.scaled(seen.pseudo)
    parameters = prior_rows.under(spectrum.scaled(seen.nuisance), flat)
    candidates = [prior_rows.below(spectrum.scaled(candidate)) for candidate in seen.candidates]
    search = LinearSearch(
        parameters[:, :0] if joint else parameters,
        [parameters] if joint else candidates,
        prior_rows.below(spectrum.scaled(seen.slow)),
        flat.new_zeros(0, 0) if slow is None else slow.scales,
        0.0 if slow is None else slow.walk_first,
    )
    return LinearisedSearch(search, prior_rows.appended(flat), spectrum, None, filling)


def _with_own_spectrum(
    plain: NoiseSpectrum,
    near: NoiseSpectrum | None,
    prior_rows: _PriorRows,
    seen: CosineProjection,
    slow: SlowBasis | None,
) -> LinearisedSearch:
    """Return the search with the most likely spectrum given a drift at the port, by alternating between the two."""
    alone = replace(seen, slow=seen.slow[..., :0])

    def without_drift_first() -> NoiseSpectrum:
        best = _build_search(plain, prior_rows, alone, None).stationary_spectrum()
        for _ in range(_REFILLED):
            found = _build_search(best, prior_rows, alone, None)
            if found.filling.nothing:
                break
            best = found.stationary_spectrum()
        return best

    if slow is None:
        return _build_search(without_drift_first(), prior_rows, seen, None)

    def with_drift_first() -> NoiseSpectrum:
        return _build_search(plain, prior_rows, seen, slow).stationary_spectrum() if near is None else near

    def tried(spectrum: Callable[[], NoiseSpectrum]) -> LinearisedSearch:
        return _build_search(spectrum(), prior_rows, seen, slow)

    def at_high_frequencies() -> NoiseSpectrum:
        spread = (seen.slow.square() * slow.scales[0].square()).sum(-1)
        return spectrum_of_fast(seen.pseudo.square(), ((spread.cumsum(0) / spread.sum(0)) < _REACHED).sum(0))

    # spectrum and drift can imitate each other: start without a drift, with a white spectrum, and from high frequencies
    spectra = (without_drift_first, with_drift_first, at_high_frequencies)
    starts = shared([partial(tried, spectrum) for spectrum in spectra], [slow, slow.tangents, slow.scales])
    best = max(starts, key=lambda found: found.evidence)
    return replace(_settled(best), others=tuple(start for start in starts if start is not best))


def _settled(found: LinearisedSearch) -> LinearisedSearch:
    """Alternate between spectrum and drift until convergence.

    The imputation of rejected samples stays fixed, because it follows any spectrum and would drive it on. The drift
    family stays fixed until the spectrum has converged, because each new spectrum needs a decomposition per family.
    """
    tried: set[int] = set()
    while (drift := found.search.noise_fit(found.series)).gain > 0 and drift.family not in tried:
        tried.add(drift.family)
        found = _settled_in(replace(found, search=found.search.of_family(drift.family)))
        found = replace(found, search=found.search.of_family(None))
    return found


def _settled_in(found: LinearisedSearch) -> LinearisedSearch:
    for _ in range(_ALTERNATIONS):
        step = found.under(found.overrelaxed_spectrum())
        if step.evidence <= found.evidence + _SETTLED:
            # the over-relaxed step may overshoot; fall back to the plain step
            step = max(step, found.under(found.stationary_spectrum()), key=lambda candidate: candidate.evidence)
        if step.evidence <= found.evidence + _SETTLED:
            break
        found = step
    return found


def _level(pseudo: Tensor) -> Tensor:
    """Root mean square of each channel, so that noisy channels have less weight from the start."""
    return pseudo.square().mean(0).sqrt().clamp(min=1e-300)


@dataclass(frozen=True)
class _PriorRows:
    """A Gaussian prior as rows below the whitened residuals."""

    root: Tensor  # (r, p)
    distance: Tensor  # (r,)

    @classmethod
    def of(cls, model: JointModel, parameters: Tensor) -> _PriorRows:
        prior = model.prior
        if prior is None:
            return cls(parameters.new_zeros(0, len(parameters)), parameters.new_zeros(0))
        precision = prior.precision if prior.precision.dim() == 2 else torch.diag(prior.precision)
        values, vectors = torch.linalg.eigh(precision)
        known = values > 0
        root = values[known].sqrt().unsqueeze(-1) * vectors[:, known].mT
        return cls(root, root @ (parameters - prior.mean))

    def under(self, nuisance: Tensor, flat: Tensor) -> Tensor:
        """Return the parameters' tangents, with the prior's rows on the scale of the residuals."""
        return torch.cat([nuisance, flat.std() * self.root])

    def below(self, columns: Tensor) -> Tensor:
        """Return other tangents, with zeros in the prior's rows."""
        return torch.cat([columns, columns.new_zeros(len(self.distance), columns.shape[-1])])

    def appended(self, flat: Tensor) -> Tensor:
        return torch.cat([flat, flat.std() * self.distance])
