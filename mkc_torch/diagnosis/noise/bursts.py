"""Bursts of outliers: samples that are rejected because of their neighbours."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.diagnosis.noise.running_median import running_median
from mkc_torch.diagnosis.settings import NoiseSettings

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["crowded", "near_median", "out_of_bursts", "rejected_in_all", "without_one_sided"]

_NEAR = 3.0
"""Robust standard deviations from a running median within which a residual counts, before a drift is known."""


def near_median(residual: Float[Tensor, "N m"], width: int, settings: NoiseSettings) -> Float[Tensor, "N m"]:
    """Return 1 for a residual within three robust scales of its running median over about ``width`` samples, else 0."""
    away = residual - running_median(residual, max(width // 2, 1))
    return rejected_in_all(
        out_of_bursts((away.abs() <= _NEAR * robust_scale(away)).to(residual.dtype), settings), settings
    )


def without_one_sided(
    quick: Float[Tensor, "N m"], counts: Float[Tensor, "N m"], settings: NoiseSettings
) -> Float[Tensor, "N m"]:
    """Return 0 for neighbourhoods of mild outliers of one sign, as in a burst, else 1; no single sample is far off.

    The means of neighbourhoods are compared with one another, so coloured noise sets its own scale.
    """
    width = min(settings.neighbours, (len(quick) - 1) // 2)
    both = torch.nn.functional.pad(torch.stack([counts, counts * quick]).mT, (width, width))
    seen, total = both.unfold(-1, 2 * width + 1, 1).sum(-1).mT
    score = total / seen.clamp(min=1.0).sqrt()
    off = (score.abs() > settings.one_sided * robust_scale(score)).to(quick.dtype)
    # reject the whole neighbourhood: a drift that still follows its edges would keep it
    return 1.0 - torch.nn.functional.max_pool1d(off.mT, 2 * width + 1, stride=1, padding=width).mT


def rejected_in_all(near: Float[Tensor, "N m"], settings: NoiseSettings) -> Float[Tensor, "N m"]:
    """Return 0 in all channels for an outlier in one channel, if outliers come in several channels together."""
    far = 1.0 - near
    coincide = far.mT @ far
    alone = coincide.diagonal().sum()
    common = coincide.sum() - alone > settings.in_common * (near.shape[1] - 1) * alone
    return near.amin(1, keepdim=True).expand_as(near) if bool(common) else near


def out_of_bursts(near: Float[Tensor, "N m"], settings: NoiseSettings) -> Float[Tensor, "N m"]:
    """Return 0 also amid outliers: a drift that follows a burst rejects its edges and its scatter only."""
    return near * ~crowded(1.0 - near, settings)


def crowded(far: Float[Tensor, "N m"], settings: NoiseSettings) -> Bool[Tensor, "N m"]:
    """Whether a sample is amid outliers, whether or not it is an outlier itself.

    Args:
        far: 1 for an outlier, else 0.
        settings: size of a neighbourhood, and the share of outliers from which it is crowded.
    """
    width = min(settings.neighbours, (len(far) - 1) // 2)
    padded = torch.nn.functional.pad(far.mT, (width, width), mode="reflect")
    return padded.unfold(-1, 2 * width + 1, 1).mean(-1).mT > settings.crowded
