"""What all pictures of a diagnosis are made of: panels placed by hand, curves with their bands, names of axes."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from mkc_torch._words.terms import term
from mkc_torch._words.typesetting import plain
from mkc_torch.diagnosis.world import Curve
from mkc_torch.report.drawing import BLUE, GREY, INK, ORANGE, STYLE

__all__ = ["BETWEEN", "CURVE_COLORS", "LEFT", "MOST_LETTERS", "RIGHT", "ROW", "WIDTH", "Grid", "array", "draw_curve",
           "named", "short", "style", "title"]  # fmt: skip

CURVE_COLORS = (BLUE, ORANGE, "#009E73", "#A8558A", "#B58900", INK)
MOST_LETTERS = 26
WIDTH = 10.0  # inches, as wide as the page
ROW, LEFT, RIGHT, BETWEEN = 1.75, 0.72, 0.1, 0.3  # inches
_OWN_AXIS = 0.45
# a name from a file may hold a dollar sign; a title of given height spares a layout of every panel
_OWN_STYLE = {"text.parse_math": False, "axes.titley": 1.0, "axes.titlesize": 10.0, "axes.titlepad": 5.0}


@contextmanager
def style() -> Iterator[None]:
    """The looks of all pictures, while one is drawn."""
    with matplotlib.rc_context(STYLE | _OWN_STYLE), warnings.catch_warnings():
        # names in letters that the font for measuring lacks; the reader's browser has them
        warnings.filterwarnings("ignore", message="Glyph .* missing from", category=UserWarning)
        yield


@dataclass(frozen=True)
class Grid:
    """Panels placed by hand, in inches: an automatic layout takes longer than all of the drawing.

    ``own_axes`` says that each panel has numbers and a name of its own.
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
        own = _OWN_AXIS if self.columns == 3 and not self.own_axes else 0.0  # the third panel has its own numbers
        width = (WIDTH - LEFT - RIGHT - own - (self.columns - 1) * between) / self.columns
        left = LEFT + column * (width + between) + (own if column == 2 else 0.0)
        bottom = self.height - self.top - (row + 1) * ROW - row * self.below
        width = WIDTH - LEFT - RIGHT if wide else width
        return figure.add_axes((left / WIDTH, bottom / self.height, width / WIDTH, ROW / self.height))


def draw_curve(ax: Any, curve: Curve, has_time: bool, most: int = MOST_LETTERS) -> None:
    """A curve with its band, a colour a channel, over what drives it."""
    x, value, band = array(curve.x), array(curve.value), array(curve.band)
    ax.axhline(0.0, color=GREY, lw=0.7, zorder=1)
    for i in range(value.shape[1]):
        color = CURVE_COLORS[i % len(CURVE_COLORS)]
        ax.fill_between(x, value[:, i] - band[:, i], value[:, i] + band[:, i], color=color, alpha=0.18, lw=0)
        ax.plot(x, value[:, i], color=color, lw=1.6)
    ax.margins(x=0.01)
    sampled = curve.driver == "time" and not has_time
    ax.set_xlabel(term("unit.sample") if sampled else named(curve.driver, curve.unit, most))
    ax.set_ylabel(named(term("finding.effect"), curve.value_unit))
    ax.locator_params(axis="x", nbins=6)
    ax.locator_params(axis="y", nbins=5)


def title(ax: Any, text: str, *, above: bool = False) -> None:
    """The title of a panel, higher where numbers stand above it."""
    ax.set_title(text, pad=18.0 if above else None)


def array(values: Tensor) -> np.ndarray:
    """Numbers to draw."""
    return values.detach().cpu().numpy()


def named(name: str, unit: str, most: int = MOST_LETTERS) -> str:
    """A name with its unit, as an axis has it."""
    return f"{short(name, most)} ({short(unit)})" if unit else short(name, most)


def short(text: str, most: int = MOST_LETTERS) -> str:
    """A text from a file, cut where there is no room."""
    told = plain(text)
    return told if len(told) <= most else told[: most - 1] + "…"
