"""The white noise of recorded columns, from differences of their own samples: no simulation enters."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_ORDERS = range(1, 9)
"""Orders of the differences: one of order k removes a polynomial of degree k − 1."""

_WHITE = 2.0**0.25
"""Largest ratio of the size of differences of samples two apart to that of neighbours.

It is 1 for white noise, √2 for a random walk and more for a smoother signal; this is halfway between the first two.
"""

_FEWEST = 30
"""Smallest number of differences."""

_GAP = 3.0
"""Longest step within a difference, in median steps."""

_CORNER, _EXPECTED, _ROUNDS = 1.5, 0.778465, 40
"""Huber's clipping point in standard deviations, mean of the clipped square of a normal variable, and iterations."""


def white_noise(
    values: Float[Tensor, "N m"],
    time: Float[Tensor, " N"],
    rounding: Float[Tensor, " m"],
    recorded: Bool[Tensor, "N m"] | None = None,
) -> Float[Tensor, " m"]:
    """Return the standard deviation of the white noise of each column; NaN where the samples do not show it.

    Divided differences of rising order, each a sum of samples with weights of unit length, remove a smooth signal and
    keep the size of white noise. Of the lowest order at which differences of samples two apart are as large as those of
    neighbours, what is left is white, and its size is returned. If there is no such order, the samples are too slow for
    the signal, or the noise is not white.

    Args:
        values: the columns, in any unit; the result is in the same.
        time: in s. Differences over gaps, and where the time does not increase, are left out.
        rounding: standard deviation of the rounding error of each column, the smallest result.
        recorded: False where a value is missing; None if none is.

    Source: von Neumann, Kent, Bellinson & Hart, Annals of Mathematical Statistics 12 (1941) 153, for the first order;
    Huber, "Robust Statistics" (1981), 6.4, for the size.

    Example:
        >>> time = torch.arange(2000, dtype=torch.float64) / 50.0
        >>> noise = torch.randn(2000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> swinging, slow = torch.sin(time) + 0.02 * noise, torch.sin(time) + 0.02 * noise.cumsum(0)
        >>> white_noise(torch.stack([swinging, slow], -1), time, torch.zeros(2))
        tensor([0.0201,    nan], dtype=torch.float64)
    """
    known = torch.ones_like(values, dtype=torch.bool) if recorded is None else recorded
    known = known & values.isfinite()
    columns = zip(values.unbind(-1), known.unbind(-1), rounding.tolist(), strict=True)
    return values.new_tensor([_white_noise(column[used], time[used], least) for column, used, least in columns])


def _white_noise(values: Float[Tensor, " N"], time: Float[Tensor, " N"], rounding: float) -> float:
    for order in _ORDERS:
        near, apart = (_differences(values, time, order, spacing) for spacing in (1, 2))
        if min(len(near), len(apart)) < _FEWEST:
            break
        size = _size(near)
        if size <= rounding:
            return rounding
        if _size(apart) <= _WHITE * size:
            return size
    return math.nan


def _differences(
    values: Float[Tensor, " N"], time: Float[Tensor, " N"], order: int, spacing: int
) -> Float[Tensor, " D"]:
    """Return divided differences with weights of unit length, of samples ``spacing`` apart."""
    reach = order * spacing
    if len(values) <= reach:
        return values[:0]
    at = time.unfold(0, reach + 1, 1)
    steps = at.diff(dim=-1)
    usual = time.diff().clamp(min=0.0).median()
    whole = ((steps > 0.0) & (steps <= _GAP * usual)).all(-1)
    at = at[whole][:, ::spacing]
    apart = (at.unsqueeze(-1) - at.unsqueeze(-2)) / usual
    weight = 1.0 / (apart + torch.eye(order + 1, dtype=at.dtype)).prod(-1)
    weight = weight / torch.linalg.vector_norm(weight, dim=-1, keepdim=True)
    return (weight * values.unfold(0, reach + 1, 1)[whole][:, ::spacing]).sum(-1)


def _size(values: Float[Tensor, " D"]) -> float:
    """Return the standard deviation about 0 by Huber's proposal 2; 0 if most values are 0.

    It is continuous, unlike a median, where the samples are rounded, and outliers hardly move it.
    """
    size = robust_scale(values.unsqueeze(-1)).squeeze()
    for _ in range(_ROUNDS if size > 0.0 else 0):
        size = (torch.minimum(values.square(), (_CORNER * size).square()).mean() / _EXPECTED).sqrt()
    return float(size)
