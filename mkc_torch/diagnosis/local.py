"""Pseudo-residuals around a wander: an outlier is what is far from the noise's own slow course, not from zero."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.density_fit import fit_density
from mkc_torch.diagnosis.linearise import SLOW_COURSES, Linearised, Slow, Tangents, linearise
from mkc_torch.diagnosis.model import JointModel
from mkc_torch.diagnosis.noise import pseudo_residual
from mkc_torch.diagnosis.refit import FittedModel
from mkc_torch.order_statistic import robust_scale

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["Local", "beside_wander", "crowded", "explained"]

_BURST, _CROWDED = 10, 0.4
"""Samples to either side, and the share of them beyond which a sample among outliers counts as one."""

_ROUNDS = 4
_NEAR = 3.0
_FAR = 2.6
"""Robust scales beyond which what is left beside the wander does not count. Where outliers five scales away are many,
the likeliest density is so wide that most of them would, and in bursts of one sign they pass for a wander."""

_ALIKE = 1e-10
"""Smallest eigenvalue, over the largest, of tangents on scales of their own that still tells them apart."""

_COMMON = 1.0 / 3.0
"""Share of a channel's outliers that are outliers in another one too, from which they have a common source."""

_OFF = 5.0
"""Robust scales of its kind beyond which the mean of a neighbourhood does not count."""

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
    noise: Linearised
    slow: Slow | None


def beside_wander(fit: FittedModel, model: JointModel, parameters: Float[Tensor, " p"], tangents: Tangents) -> Local:
    """The pseudo-residual of a fit, around the likeliest wander of its noise.

    The fit alone takes a wander that is larger than the white noise for a heavy tail, and turns down its excursions.

    Args:
        fit: its residuals are judged.
        model, parameters: where the tangents are from; ``fit`` may have a term more.
        tangents: of the parameters and of the ports.
    """
    slow = tangents.slow
    if slow is None:
        values, counts = fit.pseudo
        return Local(values, counts, linearise(model, parameters, values, counts, tangents.bare), None)
    # a burst must not pull the first course its way
    counts = _near_median(fit.residual, 2 * len(fit.residual) // SLOW_COURSES)
    values = counts * fit.residual
    noise = linearise(model, parameters, values, counts, tangents.bare, white=True)
    family = noise.search.noise_fit(noise.series).family
    for number in range(_ROUNDS):
        course = slow.course(noise.search.courses(noise.series))
        # beside a wander they are not where a fit without one has them
        course = course + explained(fit.residual - course, counts, tangents.nuisance)
        quick = fit.residual - course
        density = fit_density(quick, bound=fit.bound)
        before = counts
        values, counts = pseudo_residual(quick, density.sigma, density.d)
        near = _out_of_bursts((quick.abs() <= _FAR * robust_scale(quick)).to(quick.dtype))
        near = _of_all(near * _together(quick, counts * near))
        values, counts = values * near, counts * near
        values = values + counts * course
        if number > 0 and float((counts != before).double().mean()) < _SETTLED:
            break
        slow = slow.with_shares(noise.search.shares(noise.series, slow.channels))
        one = replace(tangents.bare, slow=slow.of_family(family))
        noise = linearise(model, parameters, values, counts, one, colour=noise.colour_beside())
    noise = linearise(model, parameters, values, counts, replace(tangents.bare, slow=slow), near=noise.colour_beside())
    return Local(values, counts, noise, slow)


def _near_median(residual: Float[Tensor, "N m"], width: int) -> Float[Tensor, "N m"]:
    """1 where a residual is within three robust scales of its running median over about ``width`` samples."""
    half = max(width // 2, 1)
    padded = torch.nn.functional.pad(residual.mT, (half, half), mode="reflect")
    away = residual - padded.unfold(-1, 2 * half + 1, 1).median(-1).values.mT
    return _of_all(_out_of_bursts((away.abs() <= _NEAR * robust_scale(away)).to(residual.dtype)))


def explained(
    values: Float[Tensor, "N m"], counts: Float[Tensor, "N m"], nuisance: Float[Tensor, "N m p"]
) -> Float[Tensor, "N m"]:
    """What the simulation's own parameters explain of it, by least squares where samples count."""
    columns = (counts.unsqueeze(-1) * nuisance).flatten(0, 1)
    scale = torch.linalg.vector_norm(columns, dim=0).clamp(min=1e-300).reciprocal()
    gram = scale.unsqueeze(-1) * (columns.mT @ columns) * scale
    inner = scale * (columns.mT @ (counts * values).flatten())
    return nuisance @ (scale * (torch.linalg.pinv(gram, hermitian=True, rtol=_ALIKE) @ inner))


def _together(quick: Float[Tensor, "N m"], counts: Float[Tensor, "N m"]) -> Float[Tensor, "N m"]:
    """0 where what counts lies to one side together, as the mild samples of a burst do: none is far by itself.

    Means over neighbourhoods are compared with one another, so that coloured noise sets its own scale.
    """
    width = min(_BURST, (len(quick) - 1) // 2)
    both = torch.nn.functional.pad(torch.stack([counts, counts * quick]).mT, (width, width))
    seen, total = both.unfold(-1, 2 * width + 1, 1).sum(-1).mT
    score = total / seen.clamp(min=1.0).sqrt()
    off = (score.abs() > _OFF * robust_scale(score)).to(quick.dtype)
    # all of each neighbourhood, for a course that may still follow its edges does not let go of it
    return 1.0 - torch.nn.functional.max_pool1d(off.mT, 2 * width + 1, stride=1, padding=width).mT


def _of_all(near: Float[Tensor, "N m"]) -> Float[Tensor, "N m"]:
    """0 in all channels for what is far in one, where outliers come in several channels together."""
    far = 1.0 - near
    coincide = far.mT @ far
    alone = coincide.diagonal().sum()
    common = coincide.sum() - alone > _COMMON * (near.shape[1] - 1) * alone
    return near.amin(1, keepdim=True).expand_as(near) if bool(common) else near


def _out_of_bursts(near: Float[Tensor, "N m"]) -> Float[Tensor, "N m"]:
    """0 also for what is in the midst of outliers: a course that follows a burst rejects its edges and its scatter."""
    return near * ~crowded(1.0 - near)


def crowded(far: Float[Tensor, "N m"]) -> Bool[Tensor, "N m"]:
    """Whether a sample is in the midst of outliers, itself one or not.

    Args:
        far: 1 for an outlier, else 0.
    """
    width = min(_BURST, (len(far) - 1) // 2)
    padded = torch.nn.functional.pad(far.mT, (width, width), mode="reflect")
    return padded.unfold(-1, 2 * width + 1, 1).mean(-1).mT > _CROWDED
