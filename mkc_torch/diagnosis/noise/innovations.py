"""Two residuals compared by what is new in each sample: their noise taken for coloured instead of white."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.diagnosis.noise.running_median import running_median
from mkc_torch.diagnosis.noise.spectrum import autoregression, filtered

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["either_way", "innovation_gain"]

_CLIPPED = 3.0
"""Robust standard deviations at which residuals are clipped around their running medians, and their squares end."""

_NEAR = 10
"""Samples to either side whose median a sample is compared with, to tell an outlier from a course."""


def innovation_gain(before: Float[Tensor, "N m"], after: Float[Tensor, "N m"]) -> float:
    """Gain in nats of the latter.

    Both residuals, clipped around their running medians, are filtered by the autoregression of the latter; what is left
    of each is compared by squares, which end at three scales (Hampel et al., "Robust Statistics", 1986, 2.6).
    """
    courses = [running_median(residual, min(_NEAR, len(residual) - 1)) for residual in (before, after)]
    reach = _CLIPPED * robust_scale(after - courses[1])
    tame = [
        course + (residual - course).clamp(-reach, reach)
        for residual, course in zip((before, after), courses, strict=True)
    ]
    total = 0.0
    for one, other in zip(*(values.unbind(-1) for values in tame), strict=True):
        coefficients = autoregression(other)
        new = torch.stack([filtered(one, coefficients), filtered(other, coefficients)])
        size = (new / robust_scale(new[1].unsqueeze(-1))).square().clamp(max=_CLIPPED**2).sum(-1)
        total += 0.5 * float(size[0] - size[1])
    return total


def either_way(one: Float[Tensor, "N m"], other: Float[Tensor, "N m"]) -> float:
    """Nats that the other gains at least, whichever's noise both are filtered by; negative if it loses, else zero.

    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> noise = torch.randn(400, 1, generator=generator, dtype=torch.float64)
        >>> decay = 2.0 * torch.exp(-(torch.arange(400) % 100) / 10.0).unsqueeze(-1)
        >>> either_way(noise + decay, noise) > 10.0 > -10.0 > either_way(noise, noise + decay)
        True
    """
    gains = innovation_gain(one, other), -innovation_gain(other, one)
    return max(min(gains), 0.0) + min(max(gains), 0.0)
