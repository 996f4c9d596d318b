"""Pseudo-residuals about a drift: an outlier is far from the noise's own slow course, not from zero."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.density.fit import fit_density
from mkc_torch.diagnosis.linearised.linearise import LinearisedSearch, linearise
from mkc_torch.diagnosis.linearised.tangents import ModelTangents, SlowBasis
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.noise.bursts import near_median, out_of_bursts, rejected_in_all, without_one_sided
from mkc_torch.diagnosis.noise.pseudo_residual import pseudo_residual
from mkc_torch.diagnosis.settings import NoiseSettings

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["Local", "drift_residuals", "explained"]

_ROUNDS = 4
"""Largest number of rounds of rejecting residuals by their distance from the drift and estimating the drift again."""

_MEDIANS = 75
"""Number of running-median windows in a recording."""

_ALIKE = 1e-10
"""Ratio of the smallest to the largest eigenvalue of normalised tangents below which they are inseparable."""

_REACH = 3.0
"""Smallest half-width of the density's domain, in robust standard deviations of the residual."""

_SETTLED = 5e-3
"""Share of samples whose mask may still change at convergence."""


@dataclass(frozen=True)
class Local:
    """Residuals about the drift, and their noise.

    Attributes:
        values: the pseudo-residuals.
        counts: 0 for a rejected residual, else 1.
        noise: their spectrum and drift; a search without candidates.
        slow: the cosines of the drift, with the share of each channel.
    """

    values: Float[Tensor, "N m"]
    counts: Float[Tensor, "N m"]
    noise: LinearisedSearch
    slow: SlowBasis | None


def drift_residuals(
    fit: FittedModel,
    model: JointModel,
    parameters: Float[Tensor, " p"],
    tangents: ModelTangents,
    settings: NoiseSettings,
) -> Local:
    """Return the pseudo-residual of a fit, about the most likely drift of its noise.

    Without the drift, a fit takes a drift larger than the white noise for a heavy tail, and rejects its excursions.

    Args:
        fit: its residuals are used.
        model, parameters: where the tangents are from; ``fit`` may have a term more.
        tangents: of the parameters and of the ports.
        settings: when a residual is rejected.
    """
    slow = tangents.slow
    if slow is None:
        values, counts = fit.pseudo(settings)
        return Local(values, counts, linearise(model, parameters, values, counts, tangents.bare), None)
    # a burst must not bias the first course
    counts = near_median(fit.residual, len(fit.residual) // _MEDIANS, settings)
    values = counts * fit.residual
    noise = linearise(model, parameters, values, counts, tangents.bare, white=True)
    family = noise.search.noise_fit(noise.series).family
    for number in range(_ROUNDS):
        course = slow.waveform(noise.search.courses(noise.series))
        # with a drift the simulation's own parameters differ from those of the fit without a drift
        course = course + explained(fit.residual - course, counts, tangents.nuisance)
        quick = fit.residual - course
        # for a poor fit the residual about the course may be larger than its domain
        density = fit_density(quick, bound=fit.bound.maximum(_REACH * robust_scale(quick)))
        before = counts
        values, counts = pseudo_residual(quick, density.sigma, density.d, settings.rejected_below)
        alone = out_of_bursts((quick.abs() <= settings.far * robust_scale(quick)).to(quick.dtype), settings)
        near = rejected_in_all(alone * without_one_sided(quick, counts * alone, settings), settings)
        if float(near.mean()) < 1.0 - settings.bursts:
            near = alone
        values, counts = values * near, counts * near
        values = values + counts * course
        if number > 0 and float((counts != before).double().mean()) < _SETTLED:
            break
        slow = slow.with_shares(noise.search.shares(noise.series, slow.channels))
        in_family = replace(tangents.bare, slow=slow.of_family(family))
        noise = linearise(model, parameters, values, counts, in_family, spectrum=noise.stationary_spectrum())
    noise = linearise(
        model, parameters, values, counts, replace(tangents.bare, slow=slow), near=noise.stationary_spectrum()
    )
    return Local(values, counts, noise, slow)


def explained(
    values: Float[Tensor, "N m"], counts: Float[Tensor, "N m"], nuisance: Float[Tensor, "N m p"]
) -> Float[Tensor, "N m"]:
    """Return what the simulation's own parameters explain of ``values``, by least squares on the samples that count."""
    columns = (counts.unsqueeze(-1) * nuisance).flatten(0, 1)
    scale = torch.linalg.vector_norm(columns, dim=0).clamp(min=1e-300).reciprocal()
    gram = scale.unsqueeze(-1) * (columns.mT @ columns) * scale
    inner = scale * (columns.mT @ (counts * values).flatten())
    return nuisance @ (scale * (torch.linalg.pinv(gram, hermitian=True, rtol=_ALIKE) @ inner))
