"""The exact h values of smallest variance of a single column."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


def smallest_variance(values: Float[Tensor, "B N"], h: int) -> Bool[Tensor, "B N"]:
    """Mask of the h > N / 2 values of smallest variance, of values standardised about their median; ties: the first.

    They are contiguous in the sorted values (Rousseeuw & Leroy, Robust Regression and Outlier Detection (1987),
    p. 171).
    """
    ordered, order = values.sort(-1)
    # the window contains the median, so it has no values beyond the reach; clipping them saves digits of the sums
    reach = 2.0 * math.sqrt(2.0 * h) * values.abs().kthvalue(h, dim=-1, keepdim=True).values
    reach = torch.where(reach > 0, reach, 1.0)  # h equal values
    ordered = torch.maximum(torch.minimum(ordered, reach), -reach)
    first, second = (torch.nn.functional.pad(power.cumsum(-1), (1, 0)) for power in (ordered, ordered.square()))
    total, squares = first[:, h:] - first[:, :-h], second[:, h:] - second[:, :-h]
    start = (squares - total.square() / h).argmin(-1, keepdim=True)
    window = start + torch.arange(h, device=values.device)
    return torch.zeros_like(values, dtype=torch.bool).scatter(1, order.gather(1, window), True)
