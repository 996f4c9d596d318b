"""Copies of the running state that compiled code may use in its backward pass."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

__all__ = ["snapshot"]


@torch.library.custom_op("mkc_torch::snapshot", mutates_args=())
def snapshot(values: Sequence[Tensor]) -> list[Tensor]:
    """Copies that are kept for the backward pass.

    torch's compiler computes cheap values in the backward pass again rather than keep them, also from buffers that the
    forward pass has changed since (pytorch#197039): the gradients would be wrong, silently. It does not compute the
    result of an operator of a library again.
    """
    return [value.clone() for value in values]


@snapshot.register_fake
def _(values: Sequence[Tensor]) -> list[Tensor]:
    return [torch.empty_like(value) for value in values]
