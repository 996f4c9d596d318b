"""Significance of the strongest candidate: p-values by surrogates, penalties, and localised evidence."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.noise.drift import NoiseFit
from mkc_torch.diagnosis.noise.outliers import crowded
from mkc_torch.diagnosis.noise.spectrum import whittle
from mkc_torch.diagnosis.search.estimate import explained
from mkc_torch.diagnosis.search.linear_search import SearchGains, log_survival
from mkc_torch.diagnosis.search.linearise import LinearisedSearch
from mkc_torch.diagnosis.search.problem import CandidateSearch
from mkc_torch.diagnosis.settings import NoiseSettings, Settings

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


def own_spectrum_gains(
    linearised: LinearisedSearch, series: Float[Tensor, "M B"], possible: Bool[Tensor, " C"]
) -> Float[Tensor, " B"]:
    """Return the gain of each series' best candidate in nats, less 1 nat per parameter, (B,).

    The search fixes the spectrum of the residuals with the effect in them, and a slow effect in quiet noise has
    coloured it. Here the spectrum is estimated again both with and without the candidate: a ratio of two likelihoods,
    each maximised over spectra (Whittle's).

    Args:
        linearised: the search; its candidates are tried.
        series: whitened by its spectrum.
        possible: candidates that may be chosen.
    """
    root = linearised.spectrum.root
    K, m = root.shape
    plain = (root / root.square().mean(0).sqrt()).flatten()
    # scale every channel by its noise, without whitening over frequencies
    without, with_candidate, dof = linearised.search.weighted(plain).residuals_of_best(
        plain.unsqueeze(-1) * series[: K * m], possible
    )
    return _evidence(with_candidate, m) - _evidence(without, m) - dof


def _evidence(series: Float[Tensor, "Km B"], m: int) -> Float[Tensor, " B"]:
    power = series.square().unflatten(0, (-1, m))
    return torch.stack([whittle(channel) for channel in power.unbind(1)]).sum(0)


def surrogate_p_value(
    linearised: LinearisedSearch,
    noise: NoiseFit,
    found: SearchGains,
    possible: Bool[Tensor, " tried"],
    count: int,
    generator: torch.Generator,
    settings: NoiseSettings,
) -> tuple[float, float]:
    """Return the p-value of the strongest candidate after the whole search, and its nats beyond the surrogates.

    Coloured noise is drawn where it enters, at a port whose axes may turn against the residual. A drift is drawn only
    if it gains clearly, because half of all white noise fits a small drift. Each candidate's ratios are first divided
    by the factor by which the surrogates exceed their chi-square (Bartlett's correction), so that a candidate with
    excess noise does not set the level for all. Shapes refined beyond the grid are left out, because the surrogates had
    no such choice; so are sizes of a sign that the physics does not allow.

    If surrogates reach the strongest candidate, recording and surrogates are compared a second time, by
    :func:`own_spectrum_gains`; the p-value is that of the smaller of both ranks.
    """
    stationary = linearised.entering(count, generator)
    if stationary is None:
        stationary = linearised.search.white(count, generator)
    if noise.gain > settings.drawn_drift:
        stationary = stationary + linearised.search.drift(count, noise, generator)
    drawn = linearised.search.gains(stationary)
    dof = found.dof.clamp(min=1.0)
    excess = (drawn.ratio.mean(-1) / dof).clamp(min=1.0).unsqueeze(-1)
    tried = len(possible)
    own = log_survival(found.ratio / excess, dof.unsqueeze(-1))[:tried, 0]
    own = torch.where(possible, own, 0.0).amin()
    others = log_survival(drawn.ratio / excess, dof.unsqueeze(-1))[:tried].amin(0)
    beyond = float(others.min() - own)
    if beyond > 0 or not bool(possible.any()):
        return (1 + int((others <= own).sum())) / (1 + count), beyond
    series = torch.cat([linearised.series.unsqueeze(-1), stationary], -1)
    allowed = torch.cat([possible, possible.new_zeros(len(found.dof) - tried)])
    gains = own_spectrum_gains(linearised, series, allowed)
    return best_rank_p_value(-torch.cat([own.unsqueeze(0), others]), gains), beyond


def best_rank_p_value(first: Float[Tensor, " B"], second: Float[Tensor, " B"]) -> float:
    """Return the p-value of the first of B series by the better of its ranks in two statistics, large for effects.

    For exchangeable series at most a share p has a p-value of p or less, whatever the dependence of the statistics.
    """
    rank = torch.minimum(*[(values >= values.unsqueeze(-1)).sum(-1) for values in (first, second)])
    return float((rank <= rank[0]).double().mean())


COUNTS = 0.0
"""Internal replacement of a p-value in a quick look, for a candidate that counts."""

COUNTS_NOT = 1.0
"""The same for a candidate that does not count."""


def price(numbers: float, samples: int, candidates: int) -> float:
    """Return the nats that a candidate has to gain to be as likely as no candidate.

    Half the logarithm of the number of samples for each of its numbers, plus the logarithm of the number of candidates:
    the extended criterion of Chen & Chen, Biometrika 95 (2008), 759, for one effect.

    Example:
        >>> round(price(2, 1000, 91), 2)
        11.42
    """
    return 0.5 * numbers * math.log(max(samples, 1)) + math.log(max(candidates, 1))


def pays(gain: float, numbers: float, samples: int, candidates: int) -> bool:
    """Whether a gain exceeds its penalty.

    Args:
        gain: log-likelihood gain, in nats.
        numbers: of the candidate.
        samples, candidates: of the recording and of the search.

    Example:
        >>> pays(12.0, 2, 1000, 91), pays(11.0, 2, 1000, 91)
        (True, False)
    """
    return gain > price(numbers, samples, candidates)


def any_pays(look: CandidateSearch, possible: Bool[Tensor, " tried"]) -> float:
    """Return :data:`COUNTS` if one of the first candidates gains more than its penalty, else :data:`COUNTS_NOT`.

    Args:
        look: the search.
        possible: which of the first candidates may count.
    """
    scene, tried = look.scene, len(possible)
    samples, physics = int(scene.counts.sum()), len({term.key for term in scene.terms[:tried]})
    gain = torch.where(possible, 0.5 * look.gains.ratio[:tried, 0], 0.0).tolist()
    known = zip(gain, look.gains.dof[:tried].tolist(), strict=True)
    return COUNTS if any(pays(nats, numbers, samples, physics) for nats, numbers in known) else COUNTS_NOT


def localised_stretch(
    pseudo: Float[Tensor, "N m"],
    counts: Float[Tensor, "N m"],
    trace: Float[Tensor, "N m"],
    nuisance: Float[Tensor, "N m p"],
    settings: Settings,
) -> tuple[int, int] | None:
    """Return first and end sample of the stretch that holds most of the evidence; None if the evidence is spread.

    None also for a recording without bursts of outliers elsewhere, because then no burst is a likely cause.

    Args:
        pseudo: pseudo-residual without the effect, 0 where masked.
        counts: 0 for a rejected residual, else 1.
        trace: the effect in it, at its most likely size.
        nuisance: tangents of the simulation's own parameters.
        settings: length of a stretch, share of the evidence in it, and definition of a burst.

    Example:
        >>> import torch
        >>> trace = torch.zeros(1000, 1, dtype=torch.float64)
        >>> trace[400:420] = 1.0
        >>> counts = torch.ones_like(trace)
        >>> counts[700:730] = 0.0
        >>> localised_stretch(trace, counts, trace, torch.ones(1000, 1, 1, dtype=torch.float64), Settings())
        (380, 420)
        >>> everything = torch.ones_like(trace)
        >>> localised_stretch(trace, everything, trace, torch.ones(1000, 1, 1, dtype=torch.float64), Settings())
    """
    N = len(pseudo)
    left = counts * (pseudo - explained(pseudo, counts, nuisance))
    own = counts * (trace - explained(trace, counts, nuisance))
    gain = (own * (left - 0.5 * own)).sum(-1)
    width = max(N // settings.search.stretches, 1)
    total = torch.cat([torch.zeros_like(gain[:1]), gain.cumsum(0)])
    within = total[width:] - total[:-width]
    first = int(within.argmax())
    if not float(within[first]) > settings.search.in_one_stretch * float(gain.sum()) > 0.0:
        return None
    elsewhere = crowded(1.0 - counts, settings.noise).amax(-1)
    elsewhere[max(first - width, 0) : first + 2 * width] = False
    return (first, first + width) if bool(elsewhere.any()) else None
