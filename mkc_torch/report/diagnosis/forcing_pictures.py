"""Figures of disturbances with their dependences, and of free curves with the named shape."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mkc_torch._support.drawing import ORANGE, array, style
from mkc_torch._support.unit_text import tidy
from mkc_torch.diagnosis.environment import Curve, DisturbanceEstimate
from mkc_torch.diagnosis.plot.drawings import MOST_LETTERS, draw_course, draw_curve, named, short
from mkc_torch.diagnosis.result import Diagnosis
from mkc_torch.report.panels import Panels, title

_MOST_CURVES = 9
"""Most states and inputs over which a disturbance is drawn."""


def of_forcing(diagnosis: Diagnosis, index: int) -> str:
    """Draw a disturbance with its band, and its mean over each state and input."""
    estimate, has_time = diagnosis.environment.disturbance[index], diagnosis.traces.has_time
    panels = Panels(2)
    with style():
        of_time = panels.axes()
        draw_course(of_time, estimate, has_time)
        of_time.set_ylabel(_quantity(estimate, estimate.unit))
        curves = [panels.axes() for _ in estimate.curves[:_MOST_CURVES]]
        for ax, curve in zip(curves, estimate.curves, strict=False):
            draw_curve(ax, curve, has_time)
            ax.set_ylabel(_quantity(estimate, curve.value_unit))
            title(ax, f"Over {short(curve.driver)}")
        _same_height(curves)
        return panels.markup(f"forcing{index + 1}", "Disturbance over time, and its mean over each state and input")


def titles(estimates: Sequence[DisturbanceEstimate]) -> list[str]:
    """Return a heading for each disturbance and drift, numbered where a state or an output has several."""
    names = [f"{'Disturbance of the rate of' if e.at_rate else 'Drift of'} `{e.place}`" for e in estimates]
    return [
        f"{name}, part {names[: i + 1].count(name)} of {names.count(name)}" if names.count(name) > 1 else name
        for i, name in enumerate(names)
    ]


def _quantity(estimate: DisturbanceEstimate, unit: str) -> str:
    """The label of an axis: the disturbance or drift, and its unit."""
    return named("disturbance" if estimate.at_rate else "drift", tidy(unit))


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
    panels = Panels(2)
    with style():
        ax = panels.axes()
        draw_curve(ax, free, diagnosis.traces.has_time, most=2 * MOST_LETTERS)
        if form is not None:
            ax.plot(array(form.x), array(form.value), color=ORANGE, lw=1.6, ls=(0, (5, 2)))
        ax.set_ylabel(named("effect", tidy(free.value_unit)))
        title(
            ax, ("Free curve with its 95 % band, and the named shape" if form is not None else "Free curve, 95 % band")
        )
        return panels.markup(f"shape{index + 1}", f"Free curve and the shape of finding {index + 1}")


def _comparable(free: Curve, form: Curve) -> bool:
    return (free.driver, free.value_unit, len(free.channels)) == (form.driver, form.value_unit, len(form.channels))
