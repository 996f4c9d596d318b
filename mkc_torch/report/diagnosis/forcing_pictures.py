"""Figures of disturbances with their dependences, and of free curves with the named shape."""

from __future__ import annotations

from typing import Any

from mkc_torch._support.drawing import ORANGE, array, style
from mkc_torch._support.unit_text import tidy
from mkc_torch._words.terms import term
from mkc_torch.diagnosis.environment import Curve
from mkc_torch.diagnosis.plot.curves import MOST_LETTERS, draw_course, draw_curve, named, short
from mkc_torch.diagnosis.result import Diagnosis
from mkc_torch.report.diagnosis.panels import PanelGrid, title
from mkc_torch.report.drawing import svg

__all__ = ["of_forcing", "of_shape"]

_IN_A_ROW = 3
_MOST_CURVES = 9


def of_forcing(diagnosis: Diagnosis, index: int) -> str:
    """Draw a disturbance with its band, and its mean over each state and input."""
    estimate, has_time = diagnosis.environment.disturbance[index], diagnosis.traces.has_time
    curves = estimate.curves[:_MOST_CURVES]
    rows = 1 + -(-len(curves) // _IN_A_ROW)
    grid = PanelGrid(rows, _IN_A_ROW, top=0.35, below=0.72, own_axes=True)
    with style():
        figure = grid.figure()
        draw_course(grid.axes(figure, 0, 0, wide=True), estimate, has_time)
        for number, curve in enumerate(curves):
            ax = grid.axes(figure, 1 + number // _IN_A_ROW, number % _IN_A_ROW)
            draw_curve(ax, curve, has_time)
            ax.set_ylabel(short(tidy(curve.value_unit)))
            title(ax, term("picture.over", name=short(curve.driver)))
        _same_height(list(figure.axes[1:]))
        return svg(figure, f"forcing{index + 1}", term("picture.about_disturbance"))


def _same_height(axes: list[Any]) -> None:
    """Use the same y scale for all curves."""
    if axes:
        low, high = (pick(ax.get_ylim()[end] for ax in axes) for end, pick in ((0, min), (1, max)))
        for ax in axes:
            ax.set_ylim(low, high)


def of_shape(diagnosis: Diagnosis, index: int) -> str | None:
    """Draw the free curve that is better than a finding's shape, with that shape; None without such a curve."""
    finding = diagnosis.findings[index]
    free = finding.shape.curve if finding.shape is not None else None
    if free is None:
        return None
    form = finding.curve if finding.curve is not None and _comparable(free, finding.curve) else None
    grid = PanelGrid(1, 1, top=0.35, below=0.0)
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
