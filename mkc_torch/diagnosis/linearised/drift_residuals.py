"""Pseudo-residuals around a wander: an outlier is what is far from the noise's own slow course, not from zero."""

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
from mkc_torch.diagnosis.noise.bursts import near_median, of_all, out_of_bursts, together
from mkc_torch.diagnosis.noise.pseudo_residual import pseudo_residual
from mkc_torch.diagnosis.settings import NoiseSettings

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["Local", "drift_residuals", "explained"]

_ROUNDS = 4
"""Times at most that residuals are judged by their distance from the wander, and the wander is estimated anew."""

_MEDIANS = 75
"""Windows of a running median that make up a recording."""

_ALIKE = 1e-10
"""Smallest eigenvalue, over the largest, of tangents on scales of their own that still tells them apart."""

_REACH = 3.0
"""Robust standard deviations of the residual that the domain of its density holds at least."""

_SETTLED = 5e-3
"""Share of the residuals that may still come to count or cease to."""


@dataclass(frozen=True)
class Local:
    """Residuals that are judged by their distance from the wander, and the noise they make.

    Attributes:
        values: the pseudo-residuals.
        counts: 0 where a residual is rejected.
        noise: their colour and wander; a search without candidates.
        slow: the courses of the wander, with the share of each channel.
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
    """The pseudo-residual of a fit, around the likeliest wander of its noise.

    The fit alone takes a wander that is larger than the white noise for a heavy tail, and turns down its excursions.

    Args:
        fit: its residuals are judged.
        model, parameters: where the tangents are from; ``fit`` may have a term more.
        tangents: of the parameters and of the ports.
        settings: when a residual is rejected.
    """
    slow = tangents.slow
    if slow is None:
        values, counts = fit.pseudo(settings)
        return Local(values, counts, linearise(model, parameters, values, counts, tangents.bare), None)
    # a burst must not pull the first course its way
    counts = near_median(fit.residual, len(fit.residual) // _MEDIANS, settings)
    values = counts * fit.residual
    noise = linearise(model, parameters, values, counts, tangents.bare, white=True)
    family = noise.search.noise_fit(noise.series).family
    for number in range(_ROUNDS):
        course = slow.waveform(noise.search.courses(noise.series))
        # beside a wander the simulation's own parameters are not where a fit without one has them
        course = course + explained(fit.residual - course, counts, tangents.nuisance)
        quick = fit.residual - course
        # beside the course of a fit that is far off the residual may be larger than its domain
        density = fit_density(quick, bound=fit.bound.maximum(_REACH * robust_scale(quick)))
        before = counts
        values, counts = pseudo_residual(quick, density.sigma, density.d, settings.rejected_below)
        alone = out_of_bursts((quick.abs() <= settings.far * robust_scale(quick)).to(quick.dtype), settings)
        near = of_all(alone * together(quick, counts * alone, settings), settings)
        if float(near.mean()) < 1.0 - settings.bursts:
            near = alone
        values, counts = values * near, counts * near
        values = values + counts * course
        if number > 0 and float((counts != before).double().mean()) < _SETTLED:
            break
        slow = slow.with_shares(noise.search.shares(noise.series, slow.channels))
        one = replace(tangents.bare, slow=slow.of_family(family))
        noise = linearise(model, parameters, values, counts, one, spectrum=noise.colour_beside())
    noise = linearise(model, parameters, values, counts, replace(tangents.bare, slow=slow), near=noise.colour_beside())
    return Local(values, counts, noise, slow)


def explained(
    values: Float[Tensor, "N m"], counts: Float[Tensor, "N m"], nuisance: Float[Tensor, "N m p"]
) -> Float[Tensor, "N m"]:
    """What the simulation's own parameters explain of it, by least squares where samples count."""
    columns = (counts.unsqueeze(-1) * nuisance).flatten(0, 1)
    scale = torch.linalg.vector_norm(columns, dim=0).clamp(min=1e-300).reciprocal()
    gram = scale.unsqueeze(-1) * (columns.mT @ columns) * scale
    inner = scale * (columns.mT @ (counts * values).flatten())
    return nuisance @ (scale * (torch.linalg.pinv(gram, hermitian=True, rtol=_ALIKE) @ inner))
