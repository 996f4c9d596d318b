"""What effects need that act on all outputs at once, each output with a number of its own."""

from __future__ import annotations

__all__ = ["SEVERAL"]

SEVERAL = "several"
"""The part of the port of all outputs where they are several and have one unit."""
