"""The pictures of what has no name: the course of a forcing with what it depends on, and free curves beside names."""

from __future__ import annotations

from typing import Any

import numpy as np

from mkc_torch._support.unit_text import tidy
from mkc_torch._words.terms import term
from mkc_torch.diagnosis.result import Diagnosis
from mkc_torch.diagnosis.world import Curve, Forcing
from mkc_torch.report.diagnosis.panels import MOST_LETTERS, Grid, array, draw_curve, named, short, style, title
from mkc_torch.report.drawing import BLUE, GREY, ORANGE, svg

__all__ = ["of_forcing", "of_shape"]

_MOST_POINTS = 2_000
_IN_A_ROW = 3
_MOST_CURVES = 9
_GAP = 5.0
"""Times the usual step beyond which two samples are not joined."""


def of_forcing(diagnosis: Diagnosis, index: int) -> str:
    """The course of a forcing with its band, and below its mean over each state and input."""
    forcing, has_time = diagnosis.world.forcing[index], diagnosis.traces.has_time
    curves = forcing.curves[:_MOST_CURVES]
    rows = 1 + -(-len(curves) // _IN_A_ROW)
    grid = Grid(rows, _IN_A_ROW, top=0.35, below=0.72, own_axes=True)
    with style():
        figure = grid.figure()
        _course(grid.axes(figure, 0, 0, wide=True), forcing, has_time)
        for number, curve in enumerate(curves):
            ax = grid.axes(figure, 1 + number // _IN_A_ROW, number % _IN_A_ROW)
            draw_curve(ax, curve, has_time)
            ax.set_ylabel(short(tidy(curve.value_unit)))
            title(ax, term("picture.over", name=short(curve.driver)))
        _same_height(list(figure.axes[1:]))
        return svg(figure, f"forcing{index + 1}", term("picture.about_forcing"))


def _course(ax: Any, forcing: Forcing, has_time: bool) -> None:
    course = array(forcing.time)
    time, value, band = (_joined(course, array(one)) for one in (forcing.time, forcing.value, forcing.band))
    ax.axhline(0.0, color=GREY, lw=0.7, zorder=1)
    ax.fill_between(time, value - band, value + band, color=BLUE, alpha=0.2, lw=0, zorder=2)
    ax.plot(time, value, color=BLUE, lw=1.2, zorder=3)
    ax.margins(x=0.01)
    ax.set_xlabel(term("picture.time" if has_time else "unit.sample"))
    ax.set_ylabel(short(tidy(forcing.unit)))
    ax.locator_params(axis="y", nbins=5)
    key = "picture.forcing" if forcing.at_rate else "picture.forcing_of_output"
    title(ax, term(key, place=short(forcing.place)))


def _joined(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Of a long course some samples, and nothing between runs, over which a line would lead."""
    step = max(-(-len(time) // _MOST_POINTS), 1)
    time, values = time[::step], values[::step].astype(float)
    steps = np.diff(time)
    if not len(steps):
        return values
    apart = np.flatnonzero((steps <= 0.0) | (steps > _GAP * np.median(steps))) + 1
    return np.insert(values, apart, np.nan)


def _same_height(axes: list[Any]) -> None:
    """One scale for all curves, so that what matters looks large."""
    if axes:
        low, high = (pick(ax.get_ylim()[end] for ax in axes) for end, pick in ((0, min), (1, max)))
        for ax in axes:
            ax.set_ylim(low, high)


def of_shape(diagnosis: Diagnosis, index: int) -> str | None:
    """The free curve that is better than a finding's name, with the form of that name; None where none is."""
    finding = diagnosis.findings[index]
    free = finding.shape.curve if finding.shape is not None else None
    if free is None:
        return None
    form = finding.curve if finding.curve is not None and _comparable(free, finding.curve) else None
    grid = Grid(1, 1, top=0.35, below=0.0)
    with style():
        figure = grid.figure()
        ax = grid.axes(figure, 0, 0, wide=True)
        draw_curve(ax, free, diagnosis.traces.has_time, most=3 * MOST_LETTERS)
        if form is not None:
            ax.plot(array(form.x), array(form.value), color=ORANGE, lw=1.6, ls=(0, (5, 2)))
        ax.set_ylabel(named(term("finding.effect"), tidy(free.value_unit)))
        title(ax, term("picture.free_curve" if form is not None else "picture.free_curve_alone"))
        return svg(figure, f"shape{index + 1}", term("picture.about_shape", number=index + 1))


def _comparable(free: Curve, form: Curve) -> bool:
    return (free.driver, free.value_unit, len(free.channels)) == (form.driver, form.value_unit, len(form.channels))
