"""The loss at the start of a training, when the residuals are unknown: sharper than the absolute value."""

from __future__ import annotations

from typing import Any

SHARPNESS = 0.2
"""Residual, in scales, of the transition from a quadratic to a square-root loss."""


def initial_loss(xp: Any, z: Any) -> Any:
    """``2 c² ((1 + (z / c)²)^(1/4) - 1)``: z² / 2 near 0, proportional to √|z| far away.

    Args:
        xp: ``numpy`` or ``torch``, the library of ``z``.
        z: residuals divided by their scale.
    """
    ratio = z / SHARPNESS
    return 2.0 * SHARPNESS**2 * (xp.sqrt(xp.sqrt(1.0 + ratio * ratio)) - 1.0)


def initial_influence(xp: Any, z: Any) -> tuple[Any, Any]:
    """First and second derivative of :func:`initial_loss`."""
    ratio = z / SHARPNESS
    square = ratio * ratio
    root = xp.sqrt(1.0 + square)
    weight = 1.0 / (root * xp.sqrt(root))
    return z * weight, weight * (1.0 - 1.5 * square / (1.0 + square))
