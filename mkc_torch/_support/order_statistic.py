"""Order statistics along the samples, weighted or not."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.side_by_side import side_by_side
from mkc_torch._support.torch_internals import forward_mode_is_active, is_wrapped

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


def order_statistic(
    values: Float[Tensor, "*batch N m"], weight: Float[Tensor, "*#batch N m"] | None, h: float
) -> Float[Tensor, "*batch m"]:
    """The h-th smallest value of each channel; with weights, the value at which their cumulated share reaches h/N.

    Args:
        values: values, ordered along the samples N.
        weight: non-negative weights that broadcast against ``values``; an integer weight repeats a value.
        h: rank in (0, N]; rounded up to an integer.
    """
    if weight is None:
        rank = math.ceil(h)
        return _selected(values, rank) if _is_plain(values) else values.kthvalue(rank, dim=-2).values
    kept = _kept(weight) if _is_plain(values) else None
    if kept is not None:
        count = int(kept.sum())
        rank = max(1, math.ceil(h / values.shape[-2] * count * (1 - 1e-12)))
        return _selected(values if count == len(kept) else values[..., kept, :], rank)
    ordered, index = values.sort(dim=-2)
    cumulated = weight.expand_as(values).gather(-2, index).cumsum(-2)
    share = h / values.shape[-2] * cumulated[..., -1:, :]
    position = (cumulated < share * (1 - 1e-12)).sum(-2, keepdim=True)
    return ordered.gather(-2, position).squeeze(-2)


def _kept(weight: Float[Tensor, "*batch N m"]) -> Bool[Tensor, " N"] | None:
    """The mask of the samples if the weights are 0 or 1 and shared by all channels and problems; else None."""
    if weight.numel() != weight.shape[-2] or weight.requires_grad or is_wrapped(weight):
        return None
    shared = weight.detach().reshape(-1)
    kept = shared == 1
    return kept if bool(kept.any()) and bool((kept | (shared == 0)).all()) else None


def _is_plain(values: Tensor) -> bool:
    """Whether NumPy may read the memory: on the CPU, float32 or float64, without derivatives and transforms."""
    return (
        not side_by_side(values)
        and values.dtype in (torch.float32, torch.float64)
        and not values.requires_grad
        and not torch.compiler.is_compiling()
        and not is_wrapped(values)
        and not forward_mode_is_active()
    )


def _selected(values: Float[Tensor, "*batch N m"], rank: int) -> Float[Tensor, "*batch m"]:
    """The value of this rank by NumPy's partition, 2 to 5 times as fast as ``torch.kthvalue``."""
    ordered = values.squeeze(-1).numpy() if values.shape[-1] == 1 else values.mT.contiguous().numpy()
    found = torch.from_numpy(np.partition(ordered, rank - 1, axis=-1)[..., rank - 1].copy())
    return found.unsqueeze(-1) if values.shape[-1] == 1 else found


def robust_scale(
    error: Float[Tensor, "*batch N m"], weight: Float[Tensor, "*batch N m"] | None = None
) -> Float[Tensor, "*batch m"]:
    """1.4826 times the median absolute residual of each channel: the standard deviation for Gaussian residuals."""
    return 1.4826 * order_statistic(error.abs(), weight, 0.5 * error.shape[-2])
