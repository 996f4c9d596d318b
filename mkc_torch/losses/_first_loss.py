"""The loss that a network begins with where nothing is known of its residuals: sharper than the absolute value."""

from __future__ import annotations

from torch import Tensor

__all__ = ["first_influence", "first_loss"]

_SHARP = 0.2
"""Where it bends, in scales."""


def first_loss(z: Tensor) -> Tensor:
    """``2 c² ((1 + (z / c)²)^(1/4) - 1)``: z² / 2 near 0, and the root of the residual far away."""
    return 2.0 * _SHARP**2 * ((1.0 + (z / _SHARP).square()).sqrt().sqrt() - 1.0)


def first_influence(z: Tensor) -> tuple[Tensor, Tensor]:
    """Its derivative, and that one's."""
    square = (z / _SHARP).square()
    bent = (1.0 + square).pow(-0.75)
    return z * bent, bent * (1.0 - 1.5 * square / (1.0 + square))
