"""The first figure of a report: the recording, the simulation as it was, and the corrected simulation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mkc_torch._support.drawing import BLUE, GREY, INK, ORANGE, PALE, array, style
from mkc_torch.diagnosis.parts import Courses
from mkc_torch.diagnosis.plot.drawings import draw_floor, named, of_time, short, unit_of_channel
from mkc_torch.diagnosis.result import Diagnosis
from mkc_torch.diagnosis.vetoes import counts
from mkc_torch.report.diagnosis.numbers import clock_of
from mkc_torch.report.diagnosis.pictures import floors
from mkc_torch.report.drawing import svg
from mkc_torch.report.panels import with_room_for_labels

MOST_OUTPUTS = 8
"""Largest number of outputs that are drawn."""

_SHARE, _FEWEST = 0.1, 40
"""Length of the enlarged stretch: share of the samples, and least number of samples."""

_BINS = 400
"""Parts of a panel; of each, the least and the largest value are drawn."""

_MOST_MARKED = 200
"""Number of recorded samples up to which each is marked by a dot."""

_GAP = 5.0
"""Gap, in median steps, across which samples are not joined."""

_BETWEEN_RUNS = 0.02
"""Space between runs that are drawn one after another, as a share of their total length."""

_BEYOND = 0.35
"""Part of the recorded range by which a simulation may extend an axis; a divergence is cut there."""

_USUAL = 0.995
"""Quantile of a residual that its axis shows."""

_WIDTH, _HEIGHT, _HEIGHT_BELOW = 4.9, 1.75, 0.8
"""Size of a panel in inches: its width, and the heights of its two axes."""

_LEFT, _RIGHT, _TOP, _BETWEEN, _BOTTOM = 0.78, 0.12, 0.35, 0.1, 0.5


@dataclass(frozen=True)
class Window:
    """Samples of a stretch, from ``first`` to before ``end``."""

    first: int
    end: int


def of_outputs(diagnosis: Diagnosis) -> str:
    """Draw each output with its residual below it, in the whole recording and in the stretch of the largest change."""
    t = diagnosis.traces
    assert t.courses is not None
    time, corrected = time_of_all_runs(diagnosis), is_corrected(diagnosis)
    window = largest_change(t.courses, corrected=corrected)
    drawn = []
    with style():
        for k in range(min(len(t.channels), MOST_OUTPUTS)):
            for number, stretch in enumerate((Window(0, len(time)), window)):
                figure = _panel(diagnosis, k, time, stretch, window, enlarged=number == 1)
                about = f"Recording and simulation: {t.channels[k]}{', enlarged' if number else ''}"
                drawn.append(svg(figure, f"output{k + 1}-{number}", escape(about)))
    return f'<div class="panels in2">{"".join(drawn)}</div>'


def is_corrected(diagnosis: Diagnosis) -> bool:
    """Whether there is a corrected simulation: whether any finding counts."""
    return any(counts(finding) for finding in diagnosis.findings)


def enlarged_stretch(diagnosis: Diagnosis) -> str:
    """Return begin and end of the enlarged stretch in words, by the time of the recording."""
    t = diagnosis.traces
    assert t.courses is not None
    window = largest_change(t.courses, corrected=is_corrected(diagnosis))
    ends = (float(t.time[k]) for k in (window.first, window.end - 1))
    run = f" of run {int(t.courses.run[window.first]) + 1}" if int(t.courses.run[-1]) > 0 else ""
    return f"{clock_of(t).interval(*ends)}{run}"


def time_of_all_runs(diagnosis: Diagnosis) -> np.ndarray:
    """Return the times of the samples, with runs whose times overlap one after another."""
    t = diagnosis.traces
    assert t.courses is not None
    time, run = array(t.time).astype(float), array(t.courses.run)
    if len(time) < 2 or bool((np.diff(time) >= 0.0).all()):
        return time
    parts = [time[run == number] for number in np.unique(run)]
    space = _BETWEEN_RUNS * sum(float(np.ptp(part)) for part in parts)
    begin, placed = float(parts[0][0]), []
    for part in parts:
        placed.append(part - part[0] + begin)
        begin = float(placed[-1][-1]) + space
    return np.concatenate(placed)


def largest_change(courses: Courses, *, corrected: bool) -> Window:
    """Return the stretch of one run in which the correction changes the simulation most, in ranges of the outputs.

    Without a correction it is the stretch of the largest residual.
    """
    recorded, before, after = (array(values) for values in (courses.recorded, courses.before, courses.corrected))
    run, count = array(courses.run), len(recorded)
    spread = np.nanmax(recorded, 0) - np.nanmin(recorded, 0) if count else np.ones(recorded.shape[1])
    change = np.abs(before - (after if corrected else recorded)) / np.where(spread > 0.0, spread, 1.0)
    # a simulation that diverges would otherwise be the only change
    size = np.square(np.minimum(np.nan_to_num(change, nan=0.0, posinf=1.0), 1.0)).sum(1)
    longest = int(np.bincount(run).max()) if count else 0
    length = min(max(round(_SHARE * count), _FEWEST), longest)
    total = np.concatenate([[0.0], np.cumsum(size)])
    first = np.arange(count - length + 1)
    whole = run[first] == run[np.maximum(first + length - 1, 0)] if count else first == 0
    sums = np.where(whole, total[first + length] - total[first], -1.0)
    begin = int(sums.argmax()) if len(sums) else 0
    return Window(begin, begin + length)


def _panel(
    diagnosis: Diagnosis, channel: int, time: np.ndarray, stretch: Window, window: Window, *, enlarged: bool
) -> Figure:
    """Draw an output and its residual over a stretch."""
    t = diagnosis.traces
    assert t.courses is not None
    height = _TOP + _HEIGHT + _BETWEEN + _HEIGHT_BELOW + _BOTTOM
    width = 1.0 - (_LEFT + _RIGHT) / _WIDTH
    figure = Figure(figsize=(_WIDTH, height))
    below = figure.add_axes((_LEFT / _WIDTH, _BOTTOM / height, width, _HEIGHT_BELOW / height))
    low = (_BOTTOM + _HEIGHT_BELOW + _BETWEEN) / height
    above = figure.add_axes((_LEFT / _WIDTH, low, width, _HEIGHT / height), sharex=below)
    rows = slice(stretch.first, stretch.end)
    x, run = (array(t.time) if enlarged else time)[rows], array(t.courses.run)[rows]
    recorded, before, corrected = (
        array(values)[rows, channel] for values in (t.courses.recorded, t.courses.before, t.courses.corrected)
    )
    simulated = [(before, ORANGE), *([(corrected, BLUE)] if is_corrected(diagnosis) else [])]
    for ax in (above, below):
        for start, end in _stretches(x, array(t.courses.held_out)[rows], run):
            ax.axvspan(start, end, color=PALE, alpha=0.18, lw=0, zorder=0)
        if not enlarged:
            for k in (window.first, window.end - 1):
                ax.axvline(time[k], color=GREY, lw=0.8, ls=(0, (2, 2)), zorder=1)
    marked = int(np.isfinite(recorded).sum()) <= _MOST_MARKED
    dots: dict[str, Any] = {"marker": "o", "ms": 2.4, "mew": 0.0} if marked else {}
    above.plot(*_line(x, recorded, run), color=INK, lw=0.6 if marked else 1.0, zorder=2, **dots)
    for values, color in simulated:
        above.plot(*_line(x, values, run), color=color, lw=1.2, zorder=3)
        below.plot(*_line(x, recorded - values, run), color=color, lw=1.0, zorder=3)
    _scale(above, recorded, [values for values, _ in simulated])
    _scale_residual(below, [recorded - values for values, _ in simulated])
    below.axhline(0.0, color=GREY, lw=0.7, zorder=1)
    draw_floor(below, floors(diagnosis).get(t.channels[channel]))
    unit = unit_of_channel(t, diagnosis.environment, channel)
    above.set_title(short(t.channels[channel]) + (", enlarged" if enlarged else ""))
    above.set_ylabel(named(t.channels[channel], unit))
    below.set_ylabel("residual")
    several = bool((np.diff(array(t.time)) < 0.0).any()) and not enlarged
    below.set_xlabel(of_time(t.has_time) + (", one run after another" if several else ""))
    above.tick_params(labelbottom=False)
    for ax in (above, below):
        ax.margins(x=0.01)
        ax.locator_params(axis="y", nbins=5 if ax is above else 3)
    below.locator_params(axis="x", nbins=6)
    with_room_for_labels(figure)
    return figure


def _line(x: np.ndarray, y: np.ndarray, run: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of a line: without missing values, thinned, and interrupted between runs and at gaps."""
    known = np.isfinite(x) & np.isfinite(y)
    x, y, run = x[known], y[known], run[known]
    if len(x) > 4 * _BINS:
        chosen = np.unique(np.concatenate(list(_extremes(y))))
        x, y, run = x[chosen], y[chosen], run[chosen]
    steps = np.diff(x)
    if not len(steps):
        return x, y
    apart = np.flatnonzero((np.diff(run) != 0) | (steps > _GAP * np.quantile(steps, 0.9))) + 1
    return np.insert(x, apart, np.nan), np.insert(y, apart, np.nan)


def _extremes(y: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the least and the largest sample of each bin: plain thinning would alias an oscillation."""
    for part in np.array_split(np.arange(len(y)), _BINS):
        yield part[[y[part].argmin(), y[part].argmax()]]


def _stretches(x: np.ndarray, inside: np.ndarray, run: np.ndarray) -> Iterator[tuple[float, float]]:
    """Yield begin and end of each group of successive samples of a run."""
    for number in np.unique(run):
        own = x[run == number]
        edges = np.flatnonzero(np.diff(np.concatenate([[0], inside[run == number].astype(int), [0]])))
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            yield float(own[begin]), float(own[min(end, len(own) - 1)])


def _scale(ax: Any, recorded: np.ndarray, simulated: list[np.ndarray]) -> None:
    """Show the whole recording, and the simulations as far as they stay near."""
    known = recorded[np.isfinite(recorded)]
    if not len(known):
        return
    low, high = float(known.min()), float(known.max())
    reach = _BEYOND * (high - low)
    finite = np.concatenate([values[np.isfinite(values)] for values in simulated])
    if len(finite):
        low = max(min(low, float(finite.min())), low - reach)
        high = min(max(high, float(finite.max())), high + reach)
    pad = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    ax.set_ylim(low - pad, high + pad)


def _scale_residual(ax: Any, residuals: list[np.ndarray]) -> None:
    sizes = [np.abs(values[np.isfinite(values)]) for values in residuals]
    limit = max((1.2 * float(np.quantile(size, _USUAL)) for size in sizes if len(size)), default=0.0)
    if limit > 0.0:
        ax.set_ylim(-limit, limit)
