"""Outliers that are told by their neighbours: what lies in the midst of others, or to one side with them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["crowded", "near_median", "of_all", "out_of_bursts", "together"]

_BURST, _CROWDED = 10, 0.4
"""Samples to either side, and the share of them beyond which a sample among outliers counts as one."""

_NEAR = 3.0

_OFF = 5.0
"""Robust scales of its kind beyond which the mean of a neighbourhood does not count."""

_COMMON = 1.0 / 3.0
"""Share of a channel's outliers that are outliers in another one too, from which they have a common source."""


def near_median(residual: Float[Tensor, "N m"], width: int) -> Float[Tensor, "N m"]:
    """1 where a residual is within three robust scales of its running median over about ``width`` samples."""
    half = max(width // 2, 1)
    padded = torch.nn.functional.pad(residual.mT, (half, half), mode="reflect")
    away = residual - padded.unfold(-1, 2 * half + 1, 1).median(-1).values.mT
    return of_all(out_of_bursts((away.abs() <= _NEAR * robust_scale(away)).to(residual.dtype)))


def together(quick: Float[Tensor, "N m"], counts: Float[Tensor, "N m"]) -> Float[Tensor, "N m"]:
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


def of_all(near: Float[Tensor, "N m"]) -> Float[Tensor, "N m"]:
    """0 in all channels for what is far in one, where outliers come in several channels together."""
    far = 1.0 - near
    coincide = far.mT @ far
    alone = coincide.diagonal().sum()
    common = coincide.sum() - alone > _COMMON * (near.shape[1] - 1) * alone
    return near.amin(1, keepdim=True).expand_as(near) if bool(common) else near


def out_of_bursts(near: Float[Tensor, "N m"]) -> Float[Tensor, "N m"]:
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
