"""The port part of effects that act on all outputs at once with one number per output."""

from __future__ import annotations

__all__ = ["SEVERAL"]

SEVERAL = "several"
"""The part of the port of all outputs, where there are several outputs with the same unit."""
