"""Copies of the running state for the backward pass of compiled code."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


# the schema is stated, because torch 2.6 derives none from `list`
@torch.library.custom_op("mkc_torch::snapshot", mutates_args=(), schema="(Tensor[] values) -> Tensor[]")
def snapshot(values: Sequence[Tensor]) -> list[Tensor]:
    """Copies that the compiler keeps for the backward pass.

    torch's compiler recomputes cheap values in the backward pass instead of keeping them, even from buffers that the
    forward pass has changed (pytorch#197039): the gradients would be wrong without a warning. It does not recompute the
    results of library operators.
    """
    return [value.clone() for value in values]


@snapshot.register_fake
def _(values: Sequence[Tensor]) -> list[Tensor]:
    return [torch.empty_like(value) for value in values]
