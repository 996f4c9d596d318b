"""Figures of a diagnosis as inline SVG: residuals before and after, curves of findings, and maps of gains."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mkc_torch._support.drawing import DARK_ORANGE, array, style
from mkc_torch.diagnosis.plot.drawings import (
    MOMENTS,
    MOST_LETTERS,
    acting_channels,
    draw_curve,
    draw_floor,
    draw_map,
    draw_residuals,
    mark_findings,
    mark_rejected,
    named,
    of_channel,
    of_time,
    onsets,
    unit_of_channel,
    units_of_outputs,
)
from mkc_torch.diagnosis.result import Diagnosis, Finding, Traces
from mkc_torch.diagnosis.vetoes import counts
from mkc_torch.report.panels import Margins, Panels, title

_MOST_ROWS, _MOST_ROWS_OF_ONE = 4, 3
_SMALL = 0.25
"""Residual after the findings, as a share of the scale before, below which its panel is enlarged."""

_CLOSE = 0.03
"""Distance, as a share of the axis, below which numbers would overlap."""


@dataclass(frozen=True)
class Panel:
    """A row of figures: the residual of a channel over a driver."""

    driver: str
    channel: int


def over_time(diagnosis: Diagnosis) -> str:
    """Draw the residual over time, one row per channel, with onsets and intervals of the findings.

    Without a finding that counts there is no column "after".
    """
    t, findings = diagnosis.traces, diagnosis.findings
    corrected = any(counts(finding) for finding in findings)
    above, known = numbered(diagnosis), floors(diagnosis)
    panels = Panels(2, margins=Margins(top=0.55 if above else 0.35))
    with style():
        for row in range(min(len(t.channels), _MOST_ROWS)):
            axes = [panels.axes() for _ in MOMENTS[: 2 if corrected else 1]]
            for ax in axes:
                mark_findings(ax, findings)
                mark_rejected(ax, diagnosis.rejected_intervals)
            draw_residuals(axes, t, array(t.time), row, unit_of_channel(t, diagnosis.environment, row))
            notes = ("", _enlarged(axes[-1], t, row)) if corrected else ("",)
            for ax, moment, note in zip(axes, MOMENTS if corrected else ("residual",), notes, strict=True):
                draw_floor(ax, known.get(t.channels[row]))
                ax.set_xlabel(of_time(t.has_time))
                title(ax, of_channel(moment, t.channels[row]) + note, above=above)
                if above:
                    _number(ax, findings)
        return panels.markup("time", "Residual over time before and after the findings were added to the simulation")


def _enlarged(ax: Any, t: Traces, channel: int) -> str:
    """Enlarge the panel of a small residual after the findings, and return a note for its title; else empty."""
    after = array(t.after[:, channel])[array(t.weight[:, channel]) >= 0.5]
    size = 1.5 * float(np.quantile(np.abs(after[np.isfinite(after)]), 0.995)) if np.isfinite(after).any() else 0.0
    if not 0.0 < size < _SMALL * ax.get_ylim()[1]:
        return ""
    ax.set_ylim(-size, size)
    return ", enlarged"


def floors(diagnosis: Diagnosis) -> dict[str, float]:
    """Return the known noise floor of each channel that is an output."""
    return {
        fit.output: fit.noise_floor
        for fit in diagnosis.environment.goodness_of_fit
        if fit.output in diagnosis.traces.channels and math.isfinite(fit.noise_floor)
    }


def numbered(diagnosis: Diagnosis) -> bool:
    """Whether the figure over time shows the numbers of findings: with several findings, of which any has a time."""
    findings = diagnosis.findings
    return len(findings) > 1 and any(f.onset is not None or f.intervals for f in findings)


def of_finding(diagnosis: Diagnosis, index: int) -> str | None:
    """Draw the curve of a finding and the residual over its drivers; None if there is neither."""
    t, finding = diagnosis.traces, diagnosis.findings[index]
    rows, curve = driver_panels(diagnosis, index), finding.curve
    if curve is None and not rows:
        return None
    together = curve is not None and len(rows) == 1
    panels = Panels(3 if together else 2)
    alone = panels if together else Panels(2)
    with style():
        for row in rows:
            axes = [panels.axes() for _ in MOMENTS]
            unit = unit_of_channel(t, diagnosis.environment, row.channel)
            draw_residuals(axes, t, array(t.drivers[row.driver]), row.channel, unit, finding)
            for ax, moment in zip(axes, MOMENTS, strict=True):
                title(ax, of_channel(moment, t.channels[row.channel]))
                ax.set_xlabel(named(row.driver, t.driver_units.get(row.driver, "")))
        if curve is not None:
            ax = alone.axes()
            draw_curve(ax, curve, t.has_time, most=MOST_LETTERS if together else 2 * MOST_LETTERS)
            title(ax, "Effect, 95 % band")
        name, about = f"finding{index + 1}", f"Curve of finding {index + 1}, and the residual over its drivers"
        above = alone.markup(f"{name}-curve", about) if curve is not None and not together else ""
        return above + (panels.markup(name, about) if rows else "")


def over_states(diagnosis: Diagnosis, index: int) -> str | None:
    """Draw a finding's gain over two states; None if it has no map."""
    found = diagnosis.findings[index].map
    if found is None:
        return None
    panels = Panels(2, height=2.55, margins=Margins(right=1.1))
    with style():
        ax = panels.axes()
        low, width = ax.get_position().y0, ax.get_position().x1
        bar = ax.figure.add_axes((width + 0.03, low, 0.025, ax.get_position().height))
        draw_map(ax, found, units_of_outputs(diagnosis.environment), bar)
        return panels.markup(f"map{index + 1}", f"Gain of finding {index + 1} over the states")


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
            color=DARK_ORANGE, fontsize=9, weight="bold",
        )  # fmt: skip


def _places(findings: Sequence[Finding]) -> Iterator[tuple[float, str]]:
    for i, finding in enumerate(findings, 1):
        if finding.onset is not None:
            yield from ((moment, str(i)) for moment in onsets(finding))
        else:
            yield from ((0.5 * (start + end), str(i)) for start, end in finding.intervals)
