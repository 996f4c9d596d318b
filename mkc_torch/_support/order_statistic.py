"""Order statistics along the samples, weighted or not."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float


def order_statistic(
    values: Float[Tensor, "*batch N m"], weight: Float[Tensor, "*#batch N m"] | None, h: float
) -> Float[Tensor, "*batch m"]:
    """The h-th smallest value of each channel; with weights, the value at which their cumulated share reaches h/N.

    Args:
        values: what is ordered along the samples N.
        weight: non-negative weights that broadcast against ``values``; a whole number counts a value so often.
        h: rank in (0, N]; what is no whole number is rounded up.
    """
    if weight is None:
        return values.kthvalue(math.ceil(h), dim=-2).values
    ordered, index = values.sort(dim=-2)
    cumulated = weight.expand_as(values).gather(-2, index).cumsum(-2)
    share = h / values.shape[-2] * cumulated[..., -1:, :]
    position = (cumulated < share * (1 - 1e-12)).sum(-2, keepdim=True)
    return ordered.gather(-2, position).squeeze(-2)


def robust_scale(
    error: Float[Tensor, "*batch N m"], weight: Float[Tensor, "*batch N m"] | None = None
) -> Float[Tensor, "*batch m"]:
    """1.4826 times the median absolute residual of each channel, the standard deviation of Gaussian ones."""
    return 1.4826 * order_statistic(error.abs(), weight, 0.5 * error.shape[-2])
