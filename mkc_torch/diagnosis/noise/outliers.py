"""Outliers: running medians, bursts of outliers, and the pseudo-residual that replaces them."""

from __future__ import annotations

from bisect import bisect_left, insort
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.diagnosis.settings import NoiseSettings

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


def running_median(values: Float[Tensor, "N m"], half: int) -> Float[Tensor, "N m"]:
    """Return the median of each value and ``half`` neighbours to either side, mirrored at the ends.

    The window is kept sorted: each new sample is inserted, and the oldest is removed.

    Args:
        values: finite values.
        half: 0 or more, and fewer than N.

    Example:
        >>> running_median(torch.tensor([[1.0], [9.0], [2.0], [3.0]]), 1).flatten()
        tensor([9., 2., 3., 2.])
    """
    padded = torch.nn.functional.pad(values.mT, (half, half), mode="reflect")
    return torch.tensor([_medians(channel, half) for channel in padded.tolist()], dtype=values.dtype).mT


def _medians(padded: list[float], half: int) -> list[float]:
    width = 2 * half + 1
    window = sorted(padded[:width])
    found = [window[half]]
    for leaves, comes in zip(padded, padded[width:], strict=False):
        del window[bisect_left(window, leaves)]
        insort(window, comes)
        found.append(window[half])
    return found


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


def pseudo_residual(
    error: Float[Tensor, "N m"], sigma: Float[Tensor, " m"], d: Float[Tensor, " m"], rejected_below: float
) -> tuple[Float[Tensor, "N m"], Float[Tensor, "N m"]]:
    """Return the score of the MKC density over its mean slope, (N, m), and the mask: 1 where a residual counts, else 0.

    Args:
        error: the residual.
        sigma, d: of the density.
        rejected_below: weight below which a residual is rejected.

    Example:
        >>> error = torch.tensor([[0.1], [-0.1], [50.0]])
        >>> values, counts = pseudo_residual(error, torch.tensor([2.0]), torch.tensor([1.0]), 0.1)
        >>> values.round(decimals=2).squeeze(-1) + 0.0, counts.squeeze(-1)
        (tensor([ 0.1000, -0.1000,  0.0000]), tensor([1., 1., 0.]))
    """
    x = sigma.pow(-2) * (error / d).square()
    weight = torch.exp(-0.5 * x)
    counts = (weight >= rejected_below).to(error.dtype)
    slope = (counts * weight * (1.0 - x)).sum(-2) / counts.sum(-2).clamp(min=1.0)
    return counts * weight * error / slope.clamp(min=0.2), counts
