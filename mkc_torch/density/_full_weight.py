"""Weights of residuals, checked and in their shape."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.arguments import refuse_bad_weight

if TYPE_CHECKING:
    from jaxtyping import Float


def full_weight(weight: Tensor, error: Float[Tensor, "*batch N m"]) -> Float[Tensor, "*batch N m"]:
    """A weight for each residual, from one for each or one for each sample.

    Raises:
        TypeError: no tensor of real numbers.
        ValueError: negative or non-finite weights, those of a channel all zero, or a shape that does not fit.
    """
    refuse_bad_weight(weight)
    try:
        # weights (N,) of as many channels as samples would be taken for those of channels
        full = weight.to(error).expand_as(error) if weight.dim() > 1 else None
    except RuntimeError:
        full = None
    if full is None:
        mend = "; one weight a sample is weight[:, None]" if weight.dim() == 1 else ""
        raise ValueError(
            f"Expected argument `weight` of shape {tuple(error.shape)} or {(error.shape[-2], 1)} but got "
            f"{tuple(weight.shape)}{mend}."
        )
    total = full.sum(-2)
    if not bool((torch.isfinite(total) & (total > 0)).all()):
        raise ValueError(
            "Expected argument `weight` to be finite, >= 0 and positive somewhere in every channel but got channels "
            f"of the sums {total.tolist()}."
        )
    return full
