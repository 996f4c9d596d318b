"""Panels of a figure, each a separate SVG element: side by side on a wide page, stacked on a narrow page."""

from __future__ import annotations

from html import escape
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from mkc_torch.report.drawing import svg

_WIDTHS = {1: 6.4, 2: 4.9, 3: 3.25}
"""Width of a panel in inches by the number of panels in a row; 99 pixels of a wide page each."""


class Margins(NamedTuple):
    """Space around the axes in inches; an automatic layout takes longer than the drawing."""

    left: float = 0.78
    right: float = 0.12
    top: float = 0.35
    bottom: float = 0.5


class Panels:
    """Panels with one axes each, in rows of ``columns``.

    Args:
        columns: number of panels in a row of a wide page, 1 to 3.
        height: height of the axes in inches.
        margins: space around the axes.
    """

    def __init__(self, columns: int, *, height: float = 1.75, margins: Margins | None = None) -> None:
        self._columns, self._height = columns, height
        self._margins = Margins() if margins is None else margins
        self._axes: list[Any] = []

    def axes(self, *, projection: str | None = None) -> Any:
        """Return the axes of a new panel."""
        width, m = _WIDTHS[self._columns], self._margins
        height = m.top + self._height + m.bottom
        place = (m.left / width, m.bottom / height, 1.0 - (m.left + m.right) / width, self._height / height)
        self._axes.append(Figure(figsize=(width, height)).add_axes(place, projection=projection))
        return self._axes[-1]

    def markup(self, name: str, description: str) -> str:
        """Return the panels as HTML; ``name`` begins the ids, ``description`` is read aloud with each title."""
        drawn = (
            svg(ax.figure, f"{name}-{i}", escape(": ".join(filter(None, (description, ax.get_title(loc="left"))))))
            for i, ax in enumerate(self._axes, 1)
        )
        return f'<div class="panels in{self._columns}">{"".join(drawn)}</div>'


def title(ax: Any, text: str, *, above: bool = False) -> None:
    """Set the title of a panel, higher if finding numbers are above it."""
    ax.set_title(text, pad=18.0 if above else None)
