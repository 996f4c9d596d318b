"""Two residuals compared by what is new in each sample: their noise taken for coloured instead of white."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.noise import autoregression, filtered
from mkc_torch.order_statistic import robust_scale

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["either_way", "innovation_gain", "innovation_gains"]

_CLIPPED = 3.0


def innovation_gains(before: Float[Tensor, "N m"], after: Float[Tensor, "N m"]) -> Float[Tensor, " N"]:
    """Gain of each sample in nats, over its channels.

    Both residuals, clipped, are filtered by the autoregression of the latter; what is left of each is compared by
    squares, which end at three scales (Hampel et al., "Robust Statistics", 1986, 2.6).
    """
    reach = _CLIPPED * robust_scale(after)
    total = torch.zeros_like(after[:, 0])
    for earlier, later, most in zip(before.unbind(-1), after.unbind(-1), reach, strict=True):
        one, other = earlier.clamp(-most, most), later.clamp(-most, most)
        coefficients = autoregression(other)
        one, other = filtered(one, coefficients), filtered(other, coefficients)
        size = (torch.stack([one, other]) / robust_scale(other.unsqueeze(-1))).square().clamp(max=_CLIPPED**2)
        total = total + 0.5 * (size[0] - size[1])
    return total


def innovation_gain(before: Float[Tensor, "N m"], after: Float[Tensor, "N m"]) -> float:
    """The sum of :func:`innovation_gains`."""
    return float(innovation_gains(before, after).sum())


def either_way(one: Float[Tensor, "N m"], other: Float[Tensor, "N m"]) -> float:
    """Nats that the other gains at least, whichever's noise both are filtered by; negative if it loses, else zero.

    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> noise = torch.randn(400, 1, generator=generator, dtype=torch.float64)
        >>> wave = 0.8 * torch.linspace(0.0, 90.0, 400, dtype=torch.float64).sin().unsqueeze(-1)
        >>> either_way(noise + wave, noise) > 40.0 > -40.0 > either_way(noise, noise + wave)
        True
    """
    gains = innovation_gain(one, other), -innovation_gain(other, one)
    return max(min(gains), 0.0) + min(max(gains), 0.0)
