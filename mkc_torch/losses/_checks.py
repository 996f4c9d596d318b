"""Arguments that the losses share, checked."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from mkc_torch._support.arguments import refuse_not_real

__all__ = ["Reduction", "checked_axis", "refuse_no_dimension", "refuse_other_reduction", "refuse_other_shapes"]

Reduction = Literal["none", "mean", "sum"]


def refuse_other_reduction(reduction: str) -> None:
    if reduction not in ("none", "mean", "sum"):
        raise ValueError(f"Expected argument `reduction` to be 'none', 'mean' or 'sum' but got {reduction!r}.")


def refuse_no_dimension(channel_dim: int) -> None:
    if isinstance(channel_dim, bool) or not isinstance(channel_dim, int):
        raise ValueError(
            f"Expected argument `channel_dim` to be a whole number but got {channel_dim!r}; -1 is the last dimension."
        )


def refuse_other_shapes(input: Tensor, target: Tensor) -> None:
    """Refuse what are no real tensors of one shape, with an element."""
    for name, value in (("input", input), ("target", target)):
        refuse_not_real(name, value)
    if input.shape != target.shape:
        short = "target" if input.dim() > target.dim() else "input"
        mend = f"unsqueeze(-1) the {short}" if input.numel() == target.numel() else "reshape one"
        raise ValueError(
            f"Expected `input` and `target` of one shape but got {tuple(input.shape)} and {tuple(target.shape)}; "
            f"{mend}: torch would broadcast them."
        )
    if input.numel() == 0:
        raise ValueError(f"Expected at least one element but got shape {tuple(input.shape)}; skip empty batches.")


def checked_axis(input: Tensor, channel_dim: int) -> int:
    """The dimension of the channels, counted from the first."""
    if not -input.dim() <= channel_dim < input.dim():
        raise ValueError(f"Expected a dimension {channel_dim} for the channels but got {tuple(input.shape)}.")
    return channel_dim % input.dim()


def at_least_float32(value: Tensor) -> torch.dtype:
    return torch.promote_types(value.dtype, torch.float32)
