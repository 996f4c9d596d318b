"""Overlay of the measured and simulated outputs, and their residuals."""

from __future__ import annotations

from typing import Any

import numpy as np

from mkc_torch._support.drawing import BLUE, GREY, ORANGE, SHADE, array, style
from mkc_torch._support.typesetting import plain
from mkc_torch.diagnosis.validation.result import CheckTraces, RecordingCheck
from mkc_torch.report.panels import Margins, Panels, title

_MOST_OUTPUTS = 4
"""Outputs that are drawn."""

_MOST_POINTS = 2_000
"""Points of a line; longer series are thinned."""


def overlay(check: RecordingCheck) -> str:
    """Draw each output and its residual without and with the findings; the first part is shaded. Returns HTML."""
    traces, panels = check.traces, Panels(2, margins=Margins(left=0.95))
    time, rows = _axis(traces), _thinned(len(traces.time))
    with style():
        for number, each in enumerate(check.outputs[:_MOST_OUTPUTS]):
            columns = (traces.measured, traces.baseline, traces.corrected)
            measured, baseline, corrected = (array(values[:, number]) for values in columns)
            unit = f", {plain(each.unit)}" if each.unit else ""
            ax = panels.axes()
            ax.plot(time[rows], measured[rows], ".", ms=2.6, color=GREY, mew=0, rasterized=True, zorder=2)
            _lines(ax, traces, time, rows, baseline, corrected)
            _finish(ax, traces, time, f"{plain(each.output)}{unit}")
            title(ax, "Measured and simulated")
            ax = panels.axes()
            ax.axhline(0.0, color=GREY, lw=0.7, zorder=1)
            _lines(ax, traces, time, rows, measured - baseline, measured - corrected)
            _finish(ax, traces, time, f"residual{unit}")
            title(ax, f"Residual of {plain(each.output)}")
    return panels.markup("check", "Measured and simulated outputs without and with the findings")


def _axis(traces: CheckTraces) -> np.ndarray:
    """Return the time axis; runs whose times overlap follow one another."""
    time, run = array(traces.time), array(traces.run)
    if not (np.diff(time) < 0).any():
        return time
    end, shifted = 0.0, time.copy()
    for number in np.unique(run):
        rows = run == number
        shifted[rows] = time[rows] - time[rows].min() + end
        end = float(shifted[rows].max())
    return shifted


def _thinned(count: int) -> slice:
    return slice(None, None, max(1, -(-count // _MOST_POINTS)))


def _lines(
    ax: Any, traces: CheckTraces, time: np.ndarray, rows: slice, baseline: np.ndarray, corrected: np.ndarray
) -> None:
    """Draw both series, not joined across runs."""
    run = array(traces.run)[rows]
    breaks = np.flatnonzero(np.diff(run)) + 1
    for values, color, dashes, width in ((baseline, ORANGE, (0, (4, 2)), 1.0), (corrected, BLUE, "-", 1.2)):
        parts = zip(np.split(time[rows], breaks), np.split(values[rows], breaks), strict=True)
        for x, y in parts:
            ax.plot(x, y, color=color, ls=dashes, lw=width, zorder=4)


def _finish(ax: Any, traces: CheckTraces, time: np.ndarray, label: str) -> None:
    """Shade the samples that the initial states were estimated from, and label the axes."""
    first = (~array(traces.predicted)).astype(int)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], first, [0]])))
    for low, high in edges.reshape(-1, 2):
        ax.axvspan(time[low], time[min(high, len(time) - 1)], color=SHADE, lw=0, zorder=0)
    ax.margins(x=0.01)
    ax.locator_params(axis="y", nbins=5)
    ax.locator_params(axis="x", nbins=6)
    ax.set_xlabel("time, s")
    ax.set_ylabel(label)
