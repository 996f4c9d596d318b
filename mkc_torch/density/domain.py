"""The domain of the MKC density: the default half-width, and the check of a given half-width."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

WIDE = 10.0
"""Smallest default half-width of the domain, in scales."""


def domain_rule(
    error: Float[Tensor, "*batch N m"],
    scale: Float[Tensor, "*batch m"],
    used: Tensor | None = None,
    scales: float = WIDE,
) -> Float[Tensor, "*batch m"]:
    """Default half-width of the domain: half the range of the residuals of a robust fit, and at least 10 scales.

    If both ends of the domain lie on the flat tail, the normaliser depends on the length of the domain alone. The
    domain is then an interval of that length that covers the residuals, centred on them or not. With ten scales,
    Gaussian data give σ = ∞; a = max|e| would over-fit the tail. Half the range, instead of a multiple of max|e|, keeps
    the density of the tail of one-sided outliers.

    Args:
        error: residuals.
        scale: robust scale of each channel.
        used: boolean mask of the residuals (True: used).
        scales: smallest half-width, in scales.
    """
    high = error if used is None else torch.where(used, error, -torch.inf)
    low = error if used is None else torch.where(used, error, torch.inf)
    return torch.maximum(0.5 * (high.amax(-2) - low.amin(-2)), scales * scale)


def refuse_bad_bound(bound: Tensor, scale: Tensor) -> None:
    """Raise ValueError for a domain shorter than the head of the density, or whose square overflows."""
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
