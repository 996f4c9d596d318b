"""Pseudo-residuals: residuals as if their noise was Gaussian, 0 where rejected."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["pseudo_residual"]


def pseudo_residual(
    error: Float[Tensor, "N m"], sigma: Float[Tensor, " m"], d: Float[Tensor, " m"], rejected_below: float
) -> tuple[Float[Tensor, "N m"], Float[Tensor, "N m"]]:
    """Return the score of the MKC density over its mean slope, (N, m), and the mask: 1 where a residual counts, else 0.

    Args:
        error: the residual.
        sigma, d: of the density.
        rejected_below: weight below which a residual is rejected.

    Example:
        >>> error = torch.tensor([[0.1], [-0.1], [50.0]])
        >>> values, counts = pseudo_residual(error, torch.tensor([2.0]), torch.tensor([1.0]), 0.1)
        >>> values.round(decimals=2).squeeze(-1) + 0.0, counts.squeeze(-1)
        (tensor([ 0.1000, -0.1000,  0.0000]), tensor([1., 1., 0.]))
    """
    x = sigma.pow(-2) * (error / d).square()
    weight = torch.exp(-0.5 * x)
    counts = (weight >= rejected_below).to(error.dtype)
    slope = (counts * weight * (1.0 - x)).sum(-2) / counts.sum(-2).clamp(min=1.0)
    return counts * weight * error / slope.clamp(min=0.2), counts
