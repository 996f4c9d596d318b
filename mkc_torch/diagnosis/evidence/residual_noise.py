"""Tests of the residual as noise: its density and its whiteness."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch._support.effective_size import effective_size
from mkc_torch.density.distribution import MKCDistribution
from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult
from mkc_torch.diagnosis.result import DensityCheck
from mkc_torch.diagnosis.settings import EvidenceSettings, Settings
from mkc_torch.recording.disturbance import RejectedInterval, disturbed_intervals

if TYPE_CHECKING:
    from jaxtyping import Float


_FREEDOM = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 10.0, 30.0)
"""Candidate degrees of freedom."""

_ROUNDS, _NODES = 30, 2001
"""EM iterations of a Student-t's scale, and nodes of the integral of its density."""

_AT_ONCE = 10_000
"""Batch size of the distribution function, which integrates over tens of nodes per sample."""

_FIRST = 20
"""Number of lags of the portmanteau statistic."""

_FARTHEST = 0.25
"""Largest lag that is tested on its own, as a share of the recording."""


def density_evidence(case: EvidenceContext) -> EvidenceResult:
    """Test the density of each channel."""
    fit = case.final.fit
    channels, settings = case.prepared.channels, case.settings.evidence
    return as_result(density_checks(fit.residual, fit.sigma, fit.d, fit.bound, channels, settings))


def as_result(checks: Sequence[DensityCheck]) -> EvidenceResult:
    content = [
        {
            "channel": check.channel,
            "distance": check.distance,
            "student_t_distance": check.student_distance,
            "degrees_of_freedom": check.degrees_of_freedom,
            "allowed": check.allowed,
        }
        for check in checks
    ]
    return EvidenceResult("density", tuple(checks), keys={"noise": {"density_check": content}})


def density_checks(
    residual: Float[Tensor, "N m"],
    sigma: Float[Tensor, " m"],
    d: Float[Tensor, " m"],
    bound: Float[Tensor, " m"],
    channels: Sequence[str],
    settings: EvidenceSettings,
) -> tuple[DensityCheck, ...]:
    """Return the Kolmogorov distances of each channel's residuals, with outliers, from their density and a Student-t.

    The density's distribution function (probability-integral transform) makes the absolute residuals uniform if the
    density is correct. A Student-t around zero is closer if the density's distance exceeds the critical distance for
    the effective number of samples, and the Student-t is more likely, at half the distance, and below the critical
    distance.

    Args:
        residual: of the final model.
        sigma, d, bound: of the density.
        channels: their names.
        settings: critical distance and ratio of the distances.

    Example:
        >>> order = torch.randperm(4000, generator=torch.Generator().manual_seed(0)).double()
        >>> cauchy = torch.tan(torch.pi * ((order + 0.5) / 4000 - 0.5)).unsqueeze(-1)
        >>> sigma, d, bound = (torch.tensor([v], dtype=torch.float64) for v in (3.0, 1.0, 2000.0))
        >>> (check,) = density_checks(cauchy, sigma, d, bound, ["norm"], EvidenceSettings())
        >>> check.degrees_of_freedom, check.closer
        (1.0, True)
    """
    size = residual.abs()
    density = MKCDistribution(sigma, d, bound, validate_args=False)
    uniform = torch.cat([2.0 * density.cdf(part) - 1.0 for part in size.split(_AT_ONCE)])
    # beyond the domain: the value at its edge
    likelihood = density.log_prob(torch.minimum(size, bound)).mean(0)
    found = []
    level = 2.0 * math.exp(-2.0 * settings.density_off**2)  # tail of Kolmogorov's distribution
    for k, channel in enumerate(channels):
        distance = kolmogorov(uniform[:, k])
        allowed = settings.density_off / math.sqrt(effective_size(uniform[:, k]))
        freedom, scale, other = student_fit(residual[:, k])
        near = kolmogorov(student_cdf(size[:, k] / scale, freedom))
        close = near < min(settings.student_closer * distance, allowed)
        closer = distance > allowed and other > float(likelihood[k]) and close
        found.append(DensityCheck(channel, distance, near, freedom, allowed, closer, level))
    return tuple(found)


def kolmogorov(uniform: Float[Tensor, " N"]) -> float:
    """Return the Kolmogorov distance of a sample from the uniform distribution on [0, 1].

    Example:
        >>> round(kolmogorov(torch.tensor([0.1, 0.3, 0.5, 0.9])), 2)
        0.25
    """
    ordered = uniform.sort().values
    N = len(ordered)
    below = torch.arange(N, dtype=ordered.dtype) / N
    return float(torch.maximum(ordered - below, below + 1.0 / N - ordered).max())


def student_fit(error: Float[Tensor, " N"]) -> tuple[float, float, float]:
    """Return degrees of freedom, scale and mean log-likelihood of the most likely Student-t around zero.

    Scale by the EM algorithm of Lange, Little & Taylor, "Robust statistical modeling using the t distribution",
    JASA 84 (1989).
    """
    freedom = error.new_tensor(_FREEDOM).unsqueeze(-1)
    square = error.square()
    least = torch.finfo(error.dtype).tiny  # all residuals may be zero
    variance = square.median().clamp(min=least).expand(len(freedom), 1)
    for _ in range(_ROUNDS):
        weight = (freedom + 1.0) / (freedom + square / variance)
        variance = (weight * square).mean(-1, keepdim=True).clamp(min=least)
    likelihood = (
        torch.lgamma(0.5 * (freedom + 1.0))
        - torch.lgamma(0.5 * freedom)
        - 0.5 * torch.log(math.pi * freedom * variance)
        - 0.5 * (freedom + 1.0) * torch.log1p(square / (freedom * variance)).mean(-1, keepdim=True)
    )
    best = int(likelihood.argmax())
    return _FREEDOM[best], float(variance[best].sqrt()), float(likelihood[best])


def student_cdf(size: Float[Tensor, " N"], freedom: float) -> Float[Tensor, " N"]:
    """Return the probability that the absolute value of a Student-t of unit scale is at most ``size``.

    With ``x = √ν tan θ`` it is the integral of ``cos^(ν-1)``, by the trapezoidal rule.

    Example:
        >>> student_cdf(torch.tensor([1.0, 12.706], dtype=torch.float64), 1.0)
        tensor([0.5000, 0.9500], dtype=torch.float64)
    """
    angle = torch.linspace(0.0, 0.5 * math.pi, _NODES, dtype=size.dtype)
    density = torch.cos(angle).clamp(min=0.0) ** (freedom - 1.0)
    total = torch.cat([density.new_zeros(1), torch.cumulative_trapezoid(density, angle)])
    place = torch.atan(size / math.sqrt(freedom)) / angle[-1] * (_NODES - 1)
    left = place.long().clamp(max=_NODES - 2)
    return torch.lerp(total[left], total[left + 1], place - left) / total[-1]


@dataclass(frozen=True)
class Whiteness:
    """Whiteness of a channel: the last significant lag in samples, 0 if white.

    ``neighbours`` is the correlation at lag 1, ``p_value`` that of the first ``lags`` lags together, ``level`` that of
    the test.
    """

    lag: int
    neighbours: float
    p_value: float
    lags: int
    level: float


def whiteness_evidence(case: EvidenceContext) -> EvidenceResult:
    """Test each channel of the final fit's pseudo-residual."""
    settings = case.settings.evidence
    values, counts = case.final.fit.pseudo(case.settings.noise)
    time = case.prepared.time
    step = 1.0 if case.prepared.recording.time is None else float(time.diff().median())
    unit = "samples" if case.prepared.recording.time is None else "s"
    channels = {
        name: whiteness(column, used, settings)
        for name, column, used in zip(case.prepared.channels, values.unbind(-1), counts.unbind(-1), strict=True)
    }
    content = [
        {
            "channel": name,
            "white": found.lag == 0,
            "lag": step * found.lag,
            "neighbours": found.neighbours,
            "p_value": found.p_value,
            "lags": found.lags,
        }
        for name, found in channels.items()
    ]
    return EvidenceResult("whiteness", channels, content={"unit": unit, "channels": content})


def whiteness(values: Float[Tensor, " N"], counts: Float[Tensor, " N"], settings: EvidenceSettings) -> Whiteness:
    """Test whether a series with masked samples is white.

    It is rejected by the portmanteau statistic of the first autocorrelations, or by an autocorrelation at any lag, with
    Bartlett's standard error, which includes the previous lags.

    Ljung & Box, "On a measure of lack of fit in time series models", Biometrika 65 (1978); with missing samples,
    Stoffer & Toloi, Statistics & Probability Letters 13 (1992). Bartlett, J. R. Stat. Soc. Suppl. 8 (1946).

    Args:
        values: the series; 0 for masked samples.
        counts: mask, 0 or 1.
        settings: level of the test.

    Example:
        >>> draws = torch.randn(2000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> sums, mask, usual = draws[1:] + draws[:-1], torch.ones_like(draws), EvidenceSettings()
        >>> whiteness(draws, mask, usual).lag, whiteness(sums, mask[1:], usual).lag
        (0, 1)
    """
    N = len(values)
    farthest = max(int(_FARTHEST * N), 1)
    centred = counts * (values - values.sum() / counts.sum().clamp(min=1.0))
    products, pairs = (_lagged_sums(count.double())[: farthest + 1] for count in (centred, counts))
    pairs = pairs.round().clamp(min=1.0)
    variance = products[0] / pairs[0]
    if float(variance) <= 0.0:
        return Whiteness(0, 0.0, 1.0, min(_FIRST, farthest), settings.white_level)
    correlation = (products / pairs / variance)[1:]
    square = correlation.square()
    first = min(_FIRST, farthest)
    statistic = (pairs[1 : first + 1] * square[:first]).sum()
    p_value = float(torch.special.gammaincc(0.5 * statistic.new_tensor(first), 0.5 * statistic))
    error = ((1.0 + 2.0 * (square.cumsum(0) - square)) / pairs[1:]).sqrt()
    size = correlation.abs() / error
    most = float(torch.special.ndtri(torch.tensor(1.0 - 0.25 * settings.white_level / farthest, dtype=torch.float64)))
    beyond = (size > most).nonzero().flatten().tolist()
    if not beyond and p_value <= 0.5 * settings.white_level:
        beyond = [int(size[:first].argmax())]
    return Whiteness(beyond[-1] + 1 if beyond else 0, float(correlation[0]), p_value, first, settings.white_level)


def _lagged_sums(values: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Return the lagged products of a series, summed over samples."""
    N = len(values)
    return torch.fft.irfft(torch.fft.rfft(values, n=2 * N).abs().square(), n=2 * N)[:N]


def localised_evidence(case: EvidenceContext) -> EvidenceResult:
    """Return the interval to which the first candidate is confined, in s; None if it is not confined."""
    located, time = case.first, case.prepared.time
    if located is None or located.stretch is None:
        return EvidenceResult("one_stretch")
    begin, end = (float(time[n]) for n in (located.stretch[0], located.stretch[1] - 1))
    return EvidenceResult("one_stretch", (begin, end))


class RejectedByFit(NamedTuple):
    """Intervals in which most samples are rejected.

    Attributes:
        final: by the fit with all findings.
        before: by the simulation without findings, which an unconfirmed finding may cover.
    """

    final: tuple[RejectedInterval, ...]
    before: tuple[RejectedInterval, ...]


def rejected_evidence(case: EvidenceContext) -> EvidenceResult:
    """Return the intervals of rejected samples; None for a recording without times."""
    if case.prepared.recording.time is None:
        return EvidenceResult("rejected")
    intervals, before = (
        rejected_intervals(case.prepared.time, fit.weights, case.settings) for fit in (case.final.fit, case.base)
    )
    return EvidenceResult("rejected", RejectedByFit(intervals, before))


def rejected_intervals(
    time: Float[Tensor, " N"], weights: Float[Tensor, "N m"], settings: Settings
) -> tuple[RejectedInterval, ...]:
    """Return the intervals in which most samples are rejected, without short bursts.

    Args:
        time: in s.
        weights: of the residuals in the final fit, in [0, 1].
        settings: weight below which a sample is rejected, and minimum length of an interval.

    Example:
        >>> import torch
        >>> time = torch.arange(1000) / 50.0
        >>> weights = torch.where((time > 4.0) & (time < 7.0), 0.0, 1.0).unsqueeze(-1)
        >>> [(round(i.start, 1), round(i.end, 1)) for i in rejected_intervals(time, weights, Settings())]
        [(4.0, 7.0)]
    """
    intervals = disturbed_intervals(time, (weights < settings.noise.rejected_below).any(-1))
    return tuple(interval for interval in intervals if interval.end - interval.start >= settings.evidence.disturbed)
