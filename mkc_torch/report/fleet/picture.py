"""The sizes of each parameter with their errors, recording by recording."""

from __future__ import annotations

from typing import Any

import numpy as np

from mkc_torch._support.drawing import BLUE, GREY, ORANGE, PALE, style
from mkc_torch._support.typesetting import plain
from mkc_torch.report.fleet.content import Fleet, Quantity
from mkc_torch.report.panels import Margins, Panels, title

_MOST = 6
"""Parameters that are drawn."""

_MOST_NAMES = 12
"""Recordings whose names are written at the axis."""


def sizes_of(fleet: Fleet) -> str:
    """Draw the sizes with 95 % intervals, mean and spread. Returns HTML, empty without a parameter to compare."""
    drawn = [quantity for quantity in fleet.quantities if quantity.pooled is not None][:_MOST]
    if not drawn:
        return ""
    rows = max(len(quantity.compared) for quantity in drawn)
    panels = Panels(2, height=min(0.9 + 0.17 * rows, 5.0), margins=Margins(left=1.35))
    with style():
        for quantity in drawn:
            _draw(panels.axes(), fleet, quantity)
    return panels.markup("fleet", "Sizes in each recording with 95 % intervals")


def _draw(ax: Any, fleet: Fleet, quantity: Quantity) -> None:
    pooled, sizes = quantity.rest or quantity.pooled, quantity.compared
    assert pooled is not None
    far = {each.unit for each in quantity.departing}
    ax.axvspan(pooled.mean - 2.0 * pooled.spread, pooled.mean + 2.0 * pooled.spread, color=PALE, lw=0, zorder=0)
    ax.axvline(pooled.mean, color=GREY, lw=0.9, zorder=1)
    places = np.arange(len(sizes))[::-1]
    for place, size in zip(places, sizes, strict=True):
        color = ORANGE if size.recording in far else BLUE
        ax.plot([size.value - 1.96 * size.error, size.value + 1.96 * size.error], [place] * 2, color=color, lw=1.4)
        ax.plot(size.value, place, "o", ms=4.0, color=color, mew=0)
    names = [plain(fleet.recordings[size.recording].name)[-18:] for size in sizes]
    ax.set_yticks(places if len(sizes) <= _MOST_NAMES else [], names if len(sizes) <= _MOST_NAMES else None)
    ax.set_ylim(-0.8, len(sizes) - 0.2)
    ax.set_xlabel(f"{plain(quantity.parameter)}{f', {plain(quantity.unit)}' if quantity.unit else ''}")
    title(ax, plain(quantity.title))
