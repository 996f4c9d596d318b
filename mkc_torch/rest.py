"""Where a sensor turns, and where it rests: a place where it stays is one direction, however long it stays there."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.order_statistic import order_statistic, robust_scale

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["thin_at_rest", "turning"]

_PARTS, _WIDEST = 200, 25
"""The way is taken over windows of a hundredth of a recording, and of no more than so many samples to either side."""

_FAR = 9.0
"""A window's way, over a sample's noise and the root of the window's length, from which it is a turn: three times what
noise alone goes, which is the difference of two medians in three channels."""

_ORDERED = 0.2
"""Noise from sample to sample, over the distance from the middle within which nine in ten samples lie, at which they
still come in an order."""

_FEWEST = 20


def turning(points: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"] | None:
    """Whether the sensor turns at each sample: a running median goes further than noise takes it.

    Args:
        points: measurements in the order of time, in any unit.

    Returns:
        None where the samples are few or show no order: each is as far from the next as from any other.

    Example:
        >>> angle = torch.cat([torch.zeros(300), torch.linspace(0.0, 6.0, 300)])
        >>> field = 40.0 * torch.stack([angle.cos(), angle.sin(), torch.zeros(600)], -1)
        >>> field = field + 0.1 * torch.randn(600, 3, generator=torch.Generator().manual_seed(0))
        >>> found = turning(field)
        >>> bool(found[:290].any()), bool(found[310:].all())
        (False, True)
        >>> turning(field[torch.randperm(600, generator=torch.Generator().manual_seed(0))]) is None
        True
    """
    N = len(points)
    if N < _FEWEST:
        return None
    # what is smooth has no second differences
    noise = robust_scale(points.diff(n=2, dim=0)).square().mean().sqrt() / math.sqrt(6.0)
    away = torch.linalg.vector_norm(points - points.median(0).values, dim=-1, keepdim=True)
    if bool(noise > _ORDERED * order_statistic(away, None, math.ceil(0.9 * N))):
        return None
    half = _half(N)
    padded = torch.nn.functional.pad(points.mT, (half, half), mode="reflect")
    middle = padded.unfold(-1, 2 * half + 1, 1).median(-1).values.mT
    number = torch.arange(N)
    before, after = (number - half).clamp(min=0), (number + half).clamp(max=N - 1)
    # at the ends of the recording there is half of the way to be seen
    way = torch.linalg.vector_norm(middle[after] - middle[before], dim=-1) * (2 * half / (after - before))
    return way > _FAR * noise / math.sqrt(2 * half + 1)


def thin_at_rest(points: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"]:
    """Which samples to take, so that a stretch of rest counts as one window of turning does: of it so many, evenly.

    Args:
        points: measurements in the order of time, in any unit.

    Example:
        >>> angle = torch.cat([torch.zeros(300), torch.linspace(0.0, 6.0, 300)])
        >>> field = 40.0 * torch.stack([angle.cos(), angle.sin(), torch.zeros(600)], -1)
        >>> taken = thin_at_rest(field + 0.1 * torch.randn(600, 3, generator=torch.Generator().manual_seed(0)))
        >>> int(taken[:290].sum()) < 10, bool(taken[310:].all())
        (True, True)
    """
    found = turning(points)
    if found is None or not bool(found.any()):
        return torch.ones_like(points[:, 0], dtype=torch.bool)
    _, run, length = torch.unique_consecutive(found, return_inverse=True, return_counts=True)
    place = torch.arange(len(points)) - (length.cumsum(0) - length)[run]
    step = (length // (2 * _half(len(points)) + 1)).clamp(min=1)[run]
    return found | (place % step == step // 2)


def _half(N: int) -> int:
    """Samples of a window to either side of its middle."""
    return min(max(N // _PARTS, 2), _WIDEST)
