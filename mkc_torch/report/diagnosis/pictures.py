"""Figures of a diagnosis as inline SVG: residuals before and after, curves of findings, and maps of gains."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure

from mkc_torch._support.drawing import array, style
from mkc_torch._words.terms import term
from mkc_torch.diagnosis.plot.curves import MOST_LETTERS, draw_curve, draw_map, named, of_time
from mkc_torch.diagnosis.plot.residual import (
    MOMENTS,
    acting_channels,
    draw_floor,
    draw_residuals,
    mark_findings,
    mark_rejected,
    of_channel,
    onsets,
)
from mkc_torch.diagnosis.result import Diagnosis, Finding
from mkc_torch.report.diagnosis.panels import LEFT, PanelGrid, title
from mkc_torch.report.drawing import svg

__all__ = ["Panel", "driver_panels", "floors", "numbered", "of_finding", "over_states", "over_time"]

_DARK = "#9A4300"
_MOST_ROWS, _MOST_ROWS_OF_ONE = 4, 3
_CLOSE = 0.03
"""Distance, as a share of the axis, below which numbers would overlap."""

_MAP, _MAP_HEIGHT = 5.6, 3.4  # inches


@dataclass(frozen=True)
class Panel:
    """A row of figures: the residual of a channel over a driver."""

    driver: str
    channel: int


def over_time(diagnosis: Diagnosis) -> str:
    """Draw the residual over time, one row per channel, with onsets and intervals of the findings.

    Without findings there is no column "after".
    """
    t, findings = diagnosis.traces, diagnosis.findings
    rows, columns = min(len(t.channels), _MOST_ROWS), 2 if findings else 1
    above, known = numbered(diagnosis), floors(diagnosis)
    grid = PanelGrid(rows, columns, top=0.55 if above else 0.35, below=0.42)
    with style():
        figure = grid.figure()
        for row in range(rows):
            axes = [grid.axes(figure, row, column) for column in range(columns)]
            for ax in axes:
                mark_findings(ax, findings)
                mark_rejected(ax, diagnosis.rejected_intervals)
            draw_residuals(axes, t, array(t.time), row)
            for ax in axes:
                draw_floor(ax, known.get(t.channels[row]))
            if above and row == 0:
                for ax in axes:
                    _number(ax, findings)
            for ax, moment in zip(axes, MOMENTS if findings else ("label.residual",), strict=True):
                title(ax, of_channel(moment, t.channels[row]), above=above and row == 0)
                if row == rows - 1:
                    ax.set_xlabel(of_time(t.has_time))
                else:
                    ax.tick_params(labelbottom=False)
        return svg(figure, "time", term("picture.about_time"))


def floors(diagnosis: Diagnosis) -> dict[str, float]:
    """Return the noise floor of each channel that is an output."""
    return {
        fit.output: fit.noise_floor
        for fit in diagnosis.environment.goodness_of_fit
        if fit.output in diagnosis.traces.channels
    }


def numbered(diagnosis: Diagnosis) -> bool:
    """Whether the figure over time shows the numbers of findings: with several findings, of which any has a time."""
    findings = diagnosis.findings
    return len(findings) > 1 and any(f.onset is not None or f.intervals for f in findings)


def of_finding(diagnosis: Diagnosis, index: int) -> str | None:
    """Draw the curve of a finding and the residual over its drivers; None if there is neither."""
    t, finding = diagnosis.traces, diagnosis.findings[index]
    panels, curve = driver_panels(diagnosis, index), finding.curve
    if curve is None and not panels:
        return None
    side_by_side = curve is not None and len(panels) == 1
    above = int(curve is not None and not side_by_side)
    grid = PanelGrid(len(panels) + above, 3 if side_by_side else 2, top=0.3, below=0.72)
    with style():
        figure = grid.figure()
        for row, panel in enumerate(panels, above):
            axes = [grid.axes(figure, row, column) for column in range(2)]
            draw_residuals(axes, t, array(t.drivers[panel.driver]), panel.channel)
            for ax, moment in zip(axes, MOMENTS, strict=True):
                title(ax, of_channel(moment, t.channels[panel.channel]))
                ax.set_xlabel(named(panel.driver, t.driver_units.get(panel.driver, "")))
        if curve is not None:
            ax = grid.axes(figure, 0, 2) if side_by_side else grid.axes(figure, 0, 0, wide=True)
            draw_curve(ax, curve, t.has_time, most=MOST_LETTERS if side_by_side else 3 * MOST_LETTERS)
            title(ax, term("picture.curve"))
        return svg(figure, f"finding{index + 1}", term("picture.about_finding", number=index + 1))


def over_states(diagnosis: Diagnosis, index: int) -> str | None:
    """Draw a finding's gain over two states; None if it has no map."""
    found = diagnosis.findings[index].map
    if found is None:
        return None
    with style():
        figure = Figure(figsize=(_MAP, _MAP_HEIGHT))
        ax = figure.add_axes((LEFT / _MAP, 0.5 / _MAP_HEIGHT, 0.72, 1.0 - 0.85 / _MAP_HEIGHT))
        draw_map(ax, found, figure.add_axes((0.86, 0.5 / _MAP_HEIGHT, 0.025, 1.0 - 0.85 / _MAP_HEIGHT)))
        return svg(figure, f"map{index + 1}", term("picture.about_map", number=index + 1))


def driver_panels(diagnosis: Diagnosis, index: int) -> list[Panel]:
    """Return drivers and channels of a finding's figures: the channels with the largest change.

    Each of several findings has a single panel, to keep the page short.
    """
    t, finding = diagnosis.traces, diagnosis.findings[index]
    drivers = [name for name in finding.drivers if name in t.drivers]
    most = _MOST_ROWS_OF_ONE if len(diagnosis.findings) == 1 else 1
    return [Panel(name, channel) for channel in acting_channels(t, finding) for name in drivers][:most]


def _number(ax: Any, findings: Sequence[Finding]) -> None:
    """Write the numbers of the findings above the panel; join those that would overlap."""
    low, high = ax.get_xlim()
    placed: list[tuple[float, str]] = []
    for place, name in sorted(_places(findings)):
        if placed and place - placed[-1][0] < _CLOSE * (high - low):
            if name not in placed[-1][1].split(", "):
                placed[-1] = (placed[-1][0], f"{placed[-1][1]}, {name}")
        else:
            placed.append((place, name))
    for place, names in placed:
        ax.text(
            place, 1.02, names, transform=ax.get_xaxis_transform(), ha="center", va="bottom",
            color=_DARK, fontsize=9, weight="bold",
        )  # fmt: skip


def _places(findings: Sequence[Finding]) -> Iterator[tuple[float, str]]:
    for i, finding in enumerate(findings, 1):
        if finding.onset is not None:
            yield from ((moment, str(i)) for moment in onsets(finding))
        else:
            yield from ((0.5 * (start + end), str(i)) for start, end in finding.intervals)
