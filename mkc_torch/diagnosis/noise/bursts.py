"""Outliers that are told by their neighbours: what lies in the midst of others, or to one side with them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.diagnosis.noise.running_median import running_median
from mkc_torch.diagnosis.settings import NoiseSettings

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["crowded", "near_median", "of_all", "out_of_bursts", "together"]

_NEAR = 3.0
"""Robust standard deviations from a running median within which a residual counts, before there is a wander."""


def near_median(residual: Float[Tensor, "N m"], width: int, settings: NoiseSettings) -> Float[Tensor, "N m"]:
    """1 where a residual is within three robust scales of its running median over about ``width`` samples."""
    away = residual - running_median(residual, max(width // 2, 1))
    return of_all(out_of_bursts((away.abs() <= _NEAR * robust_scale(away)).to(residual.dtype), settings), settings)


def together(
    quick: Float[Tensor, "N m"], counts: Float[Tensor, "N m"], settings: NoiseSettings
) -> Float[Tensor, "N m"]:
    """0 where what counts lies to one side together, as the mild samples of a burst do: none is far by itself.

    Means over neighbourhoods are compared with one another, so that coloured noise sets its own scale.
    """
    width = min(settings.neighbours, (len(quick) - 1) // 2)
    both = torch.nn.functional.pad(torch.stack([counts, counts * quick]).mT, (width, width))
    seen, total = both.unfold(-1, 2 * width + 1, 1).sum(-1).mT
    score = total / seen.clamp(min=1.0).sqrt()
    off = (score.abs() > settings.one_sided * robust_scale(score)).to(quick.dtype)
    # all of each neighbourhood, for a course that may still follow its edges does not let go of it
    return 1.0 - torch.nn.functional.max_pool1d(off.mT, 2 * width + 1, stride=1, padding=width).mT


def of_all(near: Float[Tensor, "N m"], settings: NoiseSettings) -> Float[Tensor, "N m"]:
    """0 in all channels for what is far in one, where outliers come in several channels together."""
    far = 1.0 - near
    coincide = far.mT @ far
    alone = coincide.diagonal().sum()
    common = coincide.sum() - alone > settings.in_common * (near.shape[1] - 1) * alone
    return near.amin(1, keepdim=True).expand_as(near) if bool(common) else near


def out_of_bursts(near: Float[Tensor, "N m"], settings: NoiseSettings) -> Float[Tensor, "N m"]:
    """0 also for what is in the midst of outliers: a course that follows a burst rejects its edges and its scatter."""
    return near * ~crowded(1.0 - near, settings)


def crowded(far: Float[Tensor, "N m"], settings: NoiseSettings) -> Bool[Tensor, "N m"]:
    """Whether a sample is in the midst of outliers, itself one or not.

    Args:
        far: 1 for an outlier, else 0.
        settings: how many neighbours are asked, and what share of them has to be outliers.
    """
    width = min(settings.neighbours, (len(far) - 1) // 2)
    padded = torch.nn.functional.pad(far.mT, (width, width), mode="reflect")
    return padded.unfold(-1, 2 * width + 1, 1).mean(-1).mT > settings.crowded
