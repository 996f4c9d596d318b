"""Whether the density of the residuals is right: their probability-integral transform, against a Student-t's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.effective_size import effective_size
from mkc_torch.density.distribution import MKCDistribution
from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult, Table
from mkc_torch.diagnosis.result import DensityCheck
from mkc_torch.diagnosis.settings import EvidenceSettings

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = [
    "density_checks",
    "density_warnings",
    "kolmogorov",
    "said",
    "student_cdf",
    "student_fit",
    "test",
]

_FREEDOM = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 10.0, 30.0)
"""Degrees of freedom that are tried."""

_ROUNDS, _NODES = 30, 2001
"""Of the EM algorithm for a Student-t's scale, and nodes of the integral of its density."""

_AT_ONCE = 10_000
"""Samples whose distribution function is computed together: each takes an integral over tens of nodes."""

_COLUMNS = ("channel", "distance of the density", "distance of a Student-t", "by chance up to", "")
_NOTE = (
    "The largest distance between the distribution function of the residuals and that of the density fitted to them, "
    "and of the likeliest Student-t; 0 is a perfect fit. A share of {chance:.1g} of recordings is "
    "beyond what is given as chance."
)


def test(case: EvidenceContext) -> EvidenceResult:
    """How far the density of each channel is off, and a warning where a Student-t is clearly closer."""
    fit = case.final.fit
    channels, settings = case.prepared.channels, case.settings.evidence
    return said(density_checks(fit.residual, fit.sigma, fit.d, fit.bound, channels, settings), settings)


def said(checks: Sequence[DensityCheck], settings: EvidenceSettings) -> EvidenceResult:
    # the tail of Kolmogorov's distribution
    chance = 2.0 * math.exp(-2.0 * settings.density_off**2)
    table = Table(
        "Is the density right?", _COLUMNS, tuple(_in_words(check) for check in checks), _NOTE.format(chance=chance)
    )
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
    return EvidenceResult(
        "density",
        tuple(checks),
        keys={"noise": {"density_check": content}},
        warnings=density_warnings(checks),
        table=table,
    )


def _in_words(check: DensityCheck) -> tuple[str, ...]:
    """How far a channel's density is off, how far a Student-t is, and what that says.

    Example:
        >>> _in_words(DensityCheck("norm", 0.021, 0.034, 4.0, 0.05, False))
        ('norm', '0.021', '0.034 (4 degrees of freedom)', '0.05', 'no more than chance')
    """
    verdict = "a Student-t is closer" if check.closer else "no more than chance"
    if not check.closer and check.distance > check.allowed:
        verdict = "the density is off, and a Student-t clearly no better"
    freedom = f"{check.degrees_of_freedom:g} degree{'' if check.degrees_of_freedom == 1 else 's'} of freedom"
    student = f"{check.student_distance:.2g} ({freedom})"
    return check.channel, f"{check.distance:.2g}", student, f"{check.allowed:.2g}", verdict


def density_checks(
    residual: Float[Tensor, "N m"],
    sigma: Float[Tensor, " m"],
    d: Float[Tensor, " m"],
    bound: Float[Tensor, " m"],
    channels: Sequence[str],
    settings: EvidenceSettings,
) -> tuple[DensityCheck, ...]:
    """How far the residuals of each channel, outliers among them, are from their density, and from a Student-t.

    Their sizes go through the density's distribution function (probability-integral transform), which makes them
    uniform if it is theirs; the distance is Kolmogorov's from that. The other one is that of the likeliest Student-t
    around zero. That one is the closer if the density's distance is beyond what so many samples allow, as many as their
    autocorrelation leaves, while the Student-t is likelier, at half the distance, and within what they allow.

    Args:
        residual: of the final model.
        sigma, d, bound: of the density.
        channels: their names.
        settings: what so many samples allow, and what is closer.

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
    # beyond the domain it is as on its edge
    likelihood = density.log_prob(torch.minimum(size, bound)).mean(0)
    found = []
    for k, channel in enumerate(channels):
        distance = kolmogorov(uniform[:, k])
        allowed = settings.density_off / math.sqrt(effective_size(uniform[:, k]))
        freedom, scale, other = student_fit(residual[:, k])
        near = kolmogorov(student_cdf(size[:, k] / scale, freedom))
        close = near < min(settings.student_closer * distance, allowed)
        closer = distance > allowed and other > float(likelihood[k]) and close
        found.append(DensityCheck(channel, distance, near, freedom, allowed, closer))
    return tuple(found)


def density_warnings(checks: Sequence[DensityCheck]) -> tuple[str, ...]:
    """A sentence on the channels whose residuals are clearly not of the density fitted to them, and of a Student-t.

    Outliers that neither of the two describes are not told of.

    Example:
        >>> density_warnings([DensityCheck("norm", 0.12, 0.01, 2.0, 0.05, True)])[0].partition(":")[0]
        'The density does not describe the residuals of norm'
    """
    misfit = [check for check in checks if check.closer]
    if not misfit:
        return ()
    worst = max(misfit, key=lambda check: check.distance)
    return (
        f"The density does not describe the residuals of {', '.join(check.channel for check in misfit)}: its "
        f"distribution function is off by up to {worst.distance:.2g}, that of a Student-t with "
        f"{worst.degrees_of_freedom:g} degrees of freedom by {worst.student_distance:.2g}. A misfit of the tail must "
        "not be read as physics.",
    )


def kolmogorov(uniform: Float[Tensor, " N"]) -> float:
    """Largest distance of the empirical distribution function from that of the uniform distribution on [0, 1].

    Example:
        >>> round(kolmogorov(torch.tensor([0.1, 0.3, 0.5, 0.9])), 2)
        0.25
    """
    ordered = uniform.sort().values
    N = len(ordered)
    below = torch.arange(N, dtype=ordered.dtype) / N
    return float(torch.maximum(ordered - below, below + 1.0 / N - ordered).max())


def student_fit(error: Float[Tensor, " N"]) -> tuple[float, float, float]:
    """Degrees of freedom, scale and mean log-likelihood of the likeliest Student-t around zero.

    The scale by the EM algorithm of Lange, Little & Taylor, "Robust statistical modeling using the t distribution",
    JASA 84 (1989).
    """
    freedom = error.new_tensor(_FREEDOM).unsqueeze(-1)
    square = error.square()
    least = torch.finfo(error.dtype).tiny  # of residuals that are all zero
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
    """Probability that the absolute value of a Student-t of scale one is at most ``size``.

    With ``x = √ν tan θ`` it is the integral of ``cos^(ν-1)``, here by trapezoids.

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
