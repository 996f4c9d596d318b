"""Comparison of two residuals by their innovations, for coloured noise."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.diagnosis.noise.running_median import running_median
from mkc_torch.diagnosis.noise.spectrum import autoregression, filtered

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["agreed_innovation_gain", "innovation_gain"]

_CLIPPED = 3.0
"""Robust standard deviations at which residuals are clipped around their running medians, and squares are clipped."""

_NEAR = 10
"""Samples to either side for the running median, which separates an outlier from a slow course."""


def innovation_gain(before: Float[Tensor, "N m"], after: Float[Tensor, "N m"]) -> float:
    """Return the log-likelihood gain of ``after`` over ``before`` in nats.

    Both residuals, clipped around their running medians, are filtered by the autoregression of ``after``. The
    innovations are compared by squares clipped at three scales (Hampel et al., "Robust Statistics", 1986, 2.6).
    """
    courses = [running_median(residual, min(_NEAR, len(residual) - 1)) for residual in (before, after)]
    reach = _CLIPPED * robust_scale(after - courses[1])
    tame = [
        course + (residual - course).clamp(-reach, reach)
        for residual, course in zip((before, after), courses, strict=True)
    ]
    total = 0.0
    for first, second in zip(*(values.unbind(-1) for values in tame), strict=True):
        coefficients = autoregression(second)
        new = torch.stack([filtered(first, coefficients), filtered(second, coefficients)])
        size = (new / robust_scale(new[1].unsqueeze(-1))).square().clamp(max=_CLIPPED**2).sum(-1)
        total += 0.5 * float(size[0] - size[1])
    return total


def agreed_innovation_gain(first: Float[Tensor, "N m"], other: Float[Tensor, "N m"]) -> float:
    """Return the smaller gain of ``other`` over ``first`` in nats, over the noise models of both residuals.

    Negative if it loses under both, 0 if the two disagree.

    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> noise = torch.randn(400, 1, generator=generator, dtype=torch.float64)
        >>> decay = 2.0 * torch.exp(-(torch.arange(400) % 100) / 10.0).unsqueeze(-1)
        >>> agreed_innovation_gain(noise + decay, noise) > 10.0 > -10.0 > agreed_innovation_gain(noise, noise + decay)
        True
    """
    gains = innovation_gain(first, other), -innovation_gain(other, first)
    return max(min(gains), 0.0) + min(max(gains), 0.0)
