"""Checked weights in the shape of the residuals."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.arguments import refuse_bad_weight

if TYPE_CHECKING:
    from jaxtyping import Float


def full_weight(weight: Tensor, error: Float[Tensor, "*batch N m"]) -> Float[Tensor, "*batch N m"]:
    """Weights of all residuals, from a weight per residual or per sample.

    Raises:
        TypeError: not a tensor of real numbers.
        ValueError: negative or non-finite weights, a channel of zero weights, or a shape that does not fit.
    """
    refuse_bad_weight(weight)
    try:
        # if m = N, expanding weights (N,) would take them as weights of channels
        full = weight.to(error).expand_as(error) if weight.dim() > 1 else None
    except RuntimeError:
        full = None
    if full is None:
        fix = "; for a weight per sample pass weight[:, None]" if weight.dim() == 1 else ""
        raise ValueError(
            f"Expected argument `weight` of shape {tuple(error.shape)} or {(error.shape[-2], 1)} but got "
            f"{tuple(weight.shape)}{fix}."
        )
    total = full.sum(-2)
    if not bool((torch.isfinite(total) & (total > 0)).all()):
        raise ValueError(
            "Expected argument `weight` to be finite, >= 0 and positive somewhere in every channel but got channels "
            f"of the sums {total.tolist()}."
        )
    return full
