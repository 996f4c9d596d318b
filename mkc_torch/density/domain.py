"""The domain of the MKC density: the rule for its half-width, and half-widths that are too narrow or too wide."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["WIDE", "domain_rule", "refuse_bad_bound"]

WIDE = 10.0
"""Least half-width of the domain in scales."""


def domain_rule(
    error: Float[Tensor, "*batch N m"],
    scale: Float[Tensor, "*batch m"],
    used: Tensor | None = None,
    scales: float = WIDE,
) -> Float[Tensor, "*batch m"]:
    """The half-width of the domain: half the range of the residuals of a robust fit, and no less than 10 scales.

    The normaliser depends on the length of the domain alone when both its ends lie on the flat tail, so the domain is
    an interval of that length that covers the residuals, centred on them or not. Ten scales leave Gaussian data at
    σ = ∞, where a = max|e| over-fits the tail; half the range instead of a multiple of max|e| keeps the tail of
    one-sided outliers as dense as it is.

    Args:
        error: residuals.
        scale: robust scale of each channel.
        used: boolean mask of the residuals that count.
        scales: least half-width in scales.
    """
    high = error if used is None else torch.where(used, error, -torch.inf)
    low = error if used is None else torch.where(used, error, torch.inf)
    return torch.maximum(0.5 * (high.amax(-2) - low.amin(-2)), scales * scale)


def refuse_bad_bound(bound: Tensor, scale: Tensor) -> None:
    """Refuse a domain that the head of the density does not fit in, and one whose square overflows."""
    most = torch.finfo(scale.dtype).max ** 0.4
    if not bool((bound <= most).all()):
        raise ValueError(
            f"Expected argument `bound` within {most:.1g}, beyond which squares overflow, but got "
            f"{float(bound.max()):.4g}; it is the half-width of the domain that errors can lie in."
        )
    narrow = bound < 2.0 * scale
    if bool(narrow.any()):
        first = tuple(narrow.nonzero()[0])
        raise ValueError(
            f"Expected argument `bound` to be at least two robust scales of the residuals, "
            f"{2.0 * scale[first].item():.4g}, but got {bound[first].item():.4g}; it is the domain's half-width."
        )
