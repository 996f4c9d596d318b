"""Checks of arguments that several losses have."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from mkc_torch._support.arguments import refuse_bad_weight, refuse_not_real
from mkc_torch._support.initial_values import is_readable

Reduction = Literal["none", "mean", "sum"]

_SHOWN = 6
"""Channels shown in a text, at most."""


def refuse_other_reduction(reduction: str) -> None:
    if reduction not in ("none", "mean", "sum"):
        raise ValueError(f"Expected argument `reduction` to be 'none', 'mean' or 'sum' but got {reduction!r}.")


def refuse_no_dimension(channel_dim: int) -> None:
    if isinstance(channel_dim, bool) or not isinstance(channel_dim, int):
        raise ValueError(
            f"Expected argument `channel_dim` to be a whole number but got {channel_dim!r}; -1 is the last dimension."
        )


def refuse_other_shapes(input: Tensor, target: Tensor) -> None:
    """Raise unless both are real tensors of the same shape with at least one element."""
    for name, value in (("input", input), ("target", target)):
        refuse_not_real(name, value)
    if input.shape != target.shape:
        short = "target" if input.dim() > target.dim() else "input"
        fix = f"unsqueeze(-1) the {short}" if input.numel() == target.numel() else "reshape either"
        raise ValueError(
            f"Expected `input` and `target` of the same shape but got {tuple(input.shape)} and {tuple(target.shape)}; "
            f"{fix}: torch would broadcast them."
        )
    if input.numel() == 0:
        raise ValueError(f"Expected at least one element but got shape {tuple(input.shape)}; skip empty batches.")


def checked_axis(input: Tensor, channel_dim: int) -> int:
    """The dimension of the channels, counted from the first."""
    if not -input.dim() <= channel_dim < input.dim():
        raise ValueError(f"Expected a dimension {channel_dim} for the channels but got {tuple(input.shape)}.")
    return channel_dim % input.dim()


def checked_weight(weight: Tensor, input: Tensor, axis: int, *, cast: bool = True) -> tuple[Tensor, Tensor]:
    """Weights expanded to the shape of the input, in its dtype unless ``cast`` is False, and the mask of weights not 0.

    A weight per sample lacks the channel dimension. A weight per element may have size 1 along any dimension.
    """
    refuse_bad_weight(weight)
    samples = input.shape[:axis] + input.shape[axis + 1 :]
    if weight.shape == samples and weight.shape != input.shape:
        weight = weight.unsqueeze(axis)
    elif weight.dim() != input.dim() or any(
        size not in (1, whole) for size, whole in zip(weight.shape, input.shape, strict=True)
    ):
        raise ValueError(
            f"Expected argument `weight` of shape {tuple(input.shape)}, with size 1 where it is constant, or "
            f"{tuple(samples)} but got {tuple(weight.shape)}."
        )
    weight = weight.expand(input.shape)
    if not cast:
        return weight, weight
    counts = weight if weight.dtype == torch.bool else weight != 0
    return weight.to(input.dtype), counts


def format_channels(values: Tensor) -> str:
    """The values as text: one number if all are equal, else a list of the first few."""
    if not is_readable(values):
        return format_tensor(values)
    numbers = [f"{value:.4g}" for value in values.tolist()]
    if len(set(numbers)) == 1:
        return numbers[0]
    return f"[{', '.join(numbers[:_SHOWN])}{', …' if len(numbers) > _SHOWN else ''}]"


def format_tensor(values: Tensor) -> str:
    """The values as Python writes them, or where they are if this process cannot read them."""
    if is_readable(values):
        return f"{values.tolist()}"
    return "on the meta device" if values.is_meta else "sharded"


def at_least_float32(value: Tensor) -> torch.dtype:
    return torch.promote_types(value.dtype, torch.float32)
