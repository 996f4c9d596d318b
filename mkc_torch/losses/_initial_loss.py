"""The loss that a network begins with where nothing is known of its residuals: sharper than the absolute value."""

from __future__ import annotations

from typing import Any

__all__ = ["SHARPNESS", "initial_influence", "initial_loss"]

SHARPNESS = 0.2
"""Residual, in scales, at which the loss bends from a square to a root."""


def initial_loss(xp: Any, z: Any) -> Any:
    """``2 c² ((1 + (z / c)²)^(1/4) - 1)``: z² / 2 near 0, and the root of the residual far away.

    Args:
        xp: ``numpy`` or ``torch``, whose array ``z`` is.
        z: residuals over their scale.
    """
    ratio = z / SHARPNESS
    return 2.0 * SHARPNESS**2 * (xp.sqrt(xp.sqrt(1.0 + ratio * ratio)) - 1.0)


def initial_influence(xp: Any, z: Any) -> tuple[Any, Any]:
    """The first derivative of :func:`initial_loss`, and the second."""
    ratio = z / SHARPNESS
    square = ratio * ratio
    root = xp.sqrt(1.0 + square)
    bent = 1.0 / (root * xp.sqrt(root))
    return z * bent, bent * (1.0 - 1.5 * square / (1.0 + square))
