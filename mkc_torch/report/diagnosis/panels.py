"""Panels of figures with fixed positions, and their titles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure

__all__ = ["BETWEEN", "LEFT", "RIGHT", "ROW", "WIDTH", "PanelGrid", "title"]

WIDTH = 10.0  # inches, as wide as the page
ROW, LEFT, RIGHT, BETWEEN = 1.75, 0.72, 0.1, 0.3  # inches
_OWN_AXIS = 0.45


@dataclass(frozen=True)
class PanelGrid:
    """Grid of panels, in inches; an automatic layout takes longer than the drawing.

    ``own_axes``: each panel has its own tick labels and axis label.
    """

    rows: int
    columns: int
    top: float
    below: float
    own_axes: bool = False

    @property
    def height(self) -> float:
        last = 0.5 if self.rows else 0.0
        return self.top + self.rows * ROW + (self.rows - 1) * self.below + last

    def figure(self) -> Figure:
        return Figure(figsize=(WIDTH, self.height))

    def axes(self, figure: Figure, row: int, column: int, *, wide: bool = False) -> Any:
        between = BETWEEN + (LEFT - 0.1 if self.own_axes else 0.0)
        own = _OWN_AXIS if self.columns == 3 and not self.own_axes else 0.0  # the third panel has its own tick labels
        width = (WIDTH - LEFT - RIGHT - own - (self.columns - 1) * between) / self.columns
        left = LEFT + column * (width + between) + (own if column == 2 else 0.0)
        bottom = self.height - self.top - (row + 1) * ROW - row * self.below
        width = WIDTH - LEFT - RIGHT if wide else width
        return figure.add_axes((left / WIDTH, bottom / self.height, width / WIDTH, ROW / self.height))


def title(ax: Any, text: str, *, above: bool = False) -> None:
    """Set the title of a panel, higher if finding numbers are above it."""
    ax.set_title(text, pad=18.0 if above else None)
