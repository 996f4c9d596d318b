"""Panels of a figure, each a separate SVG element: side by side on a wide page, stacked on a narrow page."""

from __future__ import annotations

from html import escape
from typing import Any, NamedTuple

from matplotlib.backends.backend_agg import FigureCanvasAgg
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
        for ax in self._axes:
            with_room_for_labels(ax.figure)
        drawn = (
            svg(ax.figure, f"{name}-{i}", escape(": ".join(filter(None, (description, ax.get_title(loc="left"))))))
            for i, ax in enumerate(self._axes, 1)
        )
        return f'<div class="panels in{self._columns}">{"".join(drawn)}</div>'


_EDGE = 2.0
"""Least distance of a label from the edge of its figure, in points."""

_FEWEST_LETTERS = 4
"""Letters that are left of a label that is too long."""


def with_room_for_labels(figure: Figure) -> None:
    """Move the edges of the axes, and shorten labels, until no label is cut at the edge of the figure.

    A label of the y axis is as long as the axes are high, or as the figure where it is the only one.
    """
    canvas = FigureCanvasAgg(figure)
    renderer = canvas.get_renderer()
    scale, axes = figure.dpi / 72.0, [ax for ax in figure.axes if ax.get_visible()]
    column = all(_in_one_column(axes[0], ax) for ax in axes)
    missing, beyond = 0.0, 0.0
    for ax in axes:
        label = ax.yaxis.label
        alone = sum(bool(other.get_ylabel()) for other in axes if _in_one_column(ax, other)) == 1
        room = figure.bbox.height if alone else ax.get_window_extent(renderer).height * 1.1
        _shorten(label, room - 2.0 * _EDGE * scale, lambda label=label: label.get_window_extent(renderer).height)
        _shorten(ax.xaxis.label, figure.bbox.width, lambda ax=ax: ax.xaxis.label.get_window_extent(renderer).width)
        box = ax.yaxis.get_tightbbox(renderer)
        if box is not None and str(ax.yaxis.get_label_position()) == "left":
            missing = max(missing, _EDGE * scale - box.x0)
        ticks = ax.xaxis.get_tightbbox(renderer)
        if ticks is not None and column:
            beyond = max(beyond, ticks.x1 - figure.bbox.width + _EDGE * scale)
        if alone and box is not None and label.get_text():
            _centre(ax, renderer)
    if missing > 0.0 or beyond > 0.0:
        left, right = missing / figure.bbox.width, beyond / figure.bbox.width
        for ax in axes:
            place = ax.get_position()
            ax.set_position((place.x0 + left, place.y0, place.width - left - right, place.height))


def _in_one_column(ax: Any, other: Any) -> bool:
    return bool(abs(ax.get_position().x0 - other.get_position().x0) < 1e-6)


def _shorten(label: Any, room: float, size: Any) -> None:
    """Cut the name in a label, before its unit in parentheses, until it fits into the room in pixels.

    A label whose unit alone is too long gets smaller letters.
    """
    text = label.get_text()
    while text and size() > room:
        name, opened, unit = text.rpartition(" (")
        name, unit = (name, f"{opened}{unit}") if opened else (unit, "")
        if len(name) <= _FEWEST_LETTERS:
            label.set_fontsize(label.get_fontsize() * room / size())
            return
        text = f"{name.removesuffix('…')[:-1]}…{unit}"
        label.set_text(text)


def _centre(ax: Any, renderer: Any) -> None:
    """Move a label that is longer than its axes along the edge, so that both its ends are inside the figure."""
    label = ax.yaxis.label
    box = label.get_window_extent(renderer)
    moved = max(_EDGE - box.y0, 0.0) - max(box.y1 - ax.figure.bbox.height + _EDGE, 0.0)
    if moved:
        label.set_y(label.get_position()[1] + moved / ax.get_window_extent(renderer).height)


def title(ax: Any, text: str, *, above: bool = False) -> None:
    """Set the title of a panel, higher if finding numbers are above it."""
    ax.set_title(text, pad=18.0 if above else None)
