"""Limits of arrays of NumPy or torch, by the cheapest call of each: ``numpy.clip`` takes five times as long."""

from __future__ import annotations

from typing import Any

__all__ = ["at_least", "at_most"]


def at_least(xp: Any, values: Any, low: float) -> Any:
    """The greater of each value and a number.

    Args:
        xp: ``numpy`` or ``torch``, whose array ``values`` is.
        values: any shape.
        low: the number.
    """
    return xp.maximum(values, low) if xp.__name__ == "numpy" else values.clamp(min=low)


def at_most(xp: Any, values: Any, high: float) -> Any:
    """The smaller of each value and a number; arguments as for :func:`at_least`."""
    return xp.minimum(values, high) if xp.__name__ == "numpy" else values.clamp(max=high)
