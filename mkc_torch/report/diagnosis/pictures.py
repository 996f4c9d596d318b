"""The pictures of a diagnosis, as inline SVG: residuals before and after, and the curve of what was found."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from mkc_torch._words.terms import term
from mkc_torch._words.typesetting import capital
from mkc_torch.diagnosis.result import Diagnosis, Finding, Traces
from mkc_torch.report.diagnosis.panels import LEFT, MOST_LETTERS, Grid, array, draw_curve, named, short, style, title
from mkc_torch.report.drawing import BLUE, GREY, INK, ORANGE, SHADE, svg

__all__ = ["Panel", "driver_panels", "floors", "numbered", "of_finding", "over_states", "over_time"]

_USED, _REJECTED, _DARK = "#7FB8DA", "#F2C7AA", "#9A4300"
_MOST_POINTS = 5_000  # of a panel
_MOST_ROWS, _MOST_ROWS_OF_ONE = 4, 3
_MOST_BINS, _FEWEST_IN_A_BIN = 60, 12
_MOST_LEVELS = 24  # of a driver that takes few values, such as a switch
_MOMENTS = ("table.before", "table.after")
_CLOSE = 0.03  # of the axis: numbers nearer than this would overlap
_MAP, _MAP_HEIGHT = 5.6, 3.4  # inches
_NEVER = "#E3E3E3"
# the pictures are transparent, so a ground of that colour would be lost
_GAIN = LinearSegmentedColormap.from_list("gain", [ORANGE, "#FFFFFF", BLUE]).with_extremes(bad=_NEVER)


@dataclass(frozen=True)
class Panel:
    """The residual of a channel over a driver: what one row of pictures shows."""

    driver: str
    channel: int


@dataclass(frozen=True)
class _Bins:
    """Mean and root mean square of the samples in use along a driver."""

    x: np.ndarray
    mean: np.ndarray
    rms: np.ndarray


def over_time(diagnosis: Diagnosis) -> str:
    """Residual before and after over time, a row a channel, with the onsets and intervals of the findings.

    Where nothing was found there is no after.
    """
    t, findings = diagnosis.traces, diagnosis.findings
    rows, columns = min(len(t.channels), _MOST_ROWS), 2 if findings else 1
    above, known = numbered(diagnosis), floors(diagnosis)
    grid = Grid(rows, columns, top=0.55 if above else 0.35, below=0.42)
    with style():
        figure = grid.figure()
        for row in range(rows):
            axes = [grid.axes(figure, row, column) for column in range(columns)]
            for ax in axes:
                _mark(ax, findings)
            _residual(axes, t, array(t.time), row)
            for ax in axes:
                _floor(ax, known.get(t.channels[row]))
            if above and row == 0:
                for ax in axes:
                    _number(ax, findings)
            for ax, moment in zip(axes, _MOMENTS if findings else ("label.residual",), strict=True):
                title(ax, _of_channel(moment, t.channels[row]), above=above and row == 0)
                if row == rows - 1:
                    ax.set_xlabel(term("picture.time" if t.has_time else "unit.sample"))
                else:
                    ax.tick_params(labelbottom=False)
        return svg(figure, "time", term("picture.about_time"))


def floors(diagnosis: Diagnosis) -> dict[str, float]:
    """The sensor's noise floor of each channel that is an output."""
    return {one.output: one.noise_floor for one in diagnosis.world.follows if one.output in diagnosis.traces.channels}


def _floor(ax: Any, size: float | None) -> None:
    """The noise floor to either side of zero."""
    for side in (-1.0, 1.0) if size is not None and math.isfinite(size) else ():
        ax.axhline(side * (size or 0.0), color=GREY, lw=1.1, ls=":", zorder=6)


def numbered(diagnosis: Diagnosis) -> bool:
    """Whether the findings' numbers stand above the residual over time: of several, if one has a place there."""
    findings = diagnosis.findings
    return len(findings) > 1 and any(f.onset is not None or f.intervals for f in findings)


def of_finding(diagnosis: Diagnosis, index: int) -> str | None:
    """The curve of a finding and the residual over its drivers; None where there is neither."""
    t, finding = diagnosis.traces, diagnosis.findings[index]
    panels, curve = driver_panels(diagnosis, index), finding.curve
    if curve is None and not panels:
        return None
    beside = curve is not None and len(panels) == 1
    above = int(curve is not None and not beside)
    grid = Grid(len(panels) + above, 3 if beside else 2, top=0.3, below=0.72)
    with style():
        figure = grid.figure()
        for row, panel in enumerate(panels, above):
            axes = [grid.axes(figure, row, column) for column in range(2)]
            _residual(axes, t, array(t.drivers[panel.driver]), panel.channel)
            for ax, moment in zip(axes, _MOMENTS, strict=True):
                title(ax, _of_channel(moment, t.channels[panel.channel]))
                ax.set_xlabel(named(panel.driver, t.driver_units.get(panel.driver, "")))
        if curve is not None:
            ax = grid.axes(figure, 0, 2) if beside else grid.axes(figure, 0, 0, wide=True)
            draw_curve(ax, curve, t.has_time, most=MOST_LETTERS if beside else 3 * MOST_LETTERS)
            title(ax, term("picture.curve"))
        return svg(figure, f"finding{index + 1}", term("picture.about_finding", number=index + 1))


def over_states(diagnosis: Diagnosis, index: int) -> str | None:
    """The map of a finding's gain over two states; None where it has none."""
    found = diagnosis.findings[index].map
    if found is None:
        return None
    nats = array(found.nats)
    shown = np.sign(nats) * np.sqrt(np.abs(nats))  # by the root: a few cells hold most
    limit = float(np.nanmax(np.abs(shown)))
    with style():
        figure = Figure(figsize=(_MAP, _MAP_HEIGHT))
        ax = figure.add_axes((LEFT / _MAP, 0.5 / _MAP_HEIGHT, 0.72, 1.0 - 0.85 / _MAP_HEIGHT))
        x, y = (array(edge) for edge in found.edges)
        drawn = ax.pcolormesh(x, y, shown.T, cmap=_GAIN, vmin=-limit, vmax=limit, rasterized=True)
        for axis, name, unit in zip((ax.xaxis, ax.yaxis), found.states, found.units, strict=True):
            axis.set_label_text(named(name, unit))
        title(ax, term("picture.map"))
        beside = figure.add_axes((0.86, 0.5 / _MAP_HEIGHT, 0.025, 1.0 - 0.85 / _MAP_HEIGHT))
        bar = figure.colorbar(drawn, cax=beside)
        beside.set_ylim(min(0.0, float(np.nanmin(shown))), limit)
        ticks = [tick for tick in bar.get_ticks() if beside.get_ylim()[0] <= tick <= limit]
        bar.set_ticks(ticks, labels=[f"{np.sign(tick) * tick**2:.3g}".replace("-", "−") for tick in ticks])
        beside.set_ylabel(term("unit.nats"))
        return svg(figure, f"map{index + 1}", term("picture.about_map", number=index + 1))


def driver_panels(diagnosis: Diagnosis, index: int) -> list[Panel]:
    """Drivers and channels of a finding's pictures: of the channels it acts on, those that change most.

    Of several findings each has one, so that the page stays short.
    """
    t, finding = diagnosis.traces, diagnosis.findings[index]
    acting = [i for i, name in enumerate(t.channels) if name in finding.channels] or list(range(len(t.channels)))
    change = (t.before - t.after).nan_to_num().square().sum(0).tolist()
    acting.sort(key=lambda i: -change[i])
    drivers = [name for name in finding.drivers if name in t.drivers]
    most = _MOST_ROWS_OF_ONE if len(diagnosis.findings) == 1 else 1
    return [Panel(name, channel) for channel in acting for name in drivers][:most]


def _residual(axes: Sequence[Any], t: Traces, x: np.ndarray, channel: int) -> None:
    """Draw samples, and the mean and size of those in use, before and, in a second panel, after."""
    before, used = array(t.before[:, channel]), array(t.weight[:, channel]) >= 0.5
    limit, earlier, shown = _limit(before[used]), _binned(x[used], before[used]), _apart(x)
    marker = "o" if len(earlier.x) <= _MOST_LEVELS else ""
    for ax, after in zip(axes, (False, True), strict=False):
        e = array(t.after[:, channel]) if after else before
        near = np.isfinite(x) & (np.abs(e) <= limit)
        ax.axhline(0.0, color=GREY, lw=0.7, zorder=1)
        for mask, color in ((near & ~used, _REJECTED), (near & used, _USED)):
            index = _thinned(np.flatnonzero(mask))
            ax.plot(shown[index], e[index], ".", ms=2.4, color=color, mew=0, rasterized=True, zorder=2)
        _envelope(ax, earlier, color=ORANGE, ls=(0, (4, 2)) if after else "-")
        bins = _binned(x[used], e[used]) if after else earlier
        if after:
            _envelope(ax, bins, color=BLUE, ls="-")
        ax.plot(bins.x, bins.mean, color=INK, lw=1.4, marker=marker, ms=3.5, zorder=5)
        ax.set_ylim(-limit, limit)
        ax.margins(x=0.01)
        ax.locator_params(axis="y", nbins=5)
        ax.locator_params(axis="x", nbins=6)
    axes[0].set_ylabel(named(term("label.residual"), t.unit))
    for ax in axes[1:]:
        ax.tick_params(labelleft=False)


def _envelope(ax: Any, bins: _Bins, **style: Any) -> None:
    for side in (-1.0, 1.0):
        ax.plot(bins.x, side * bins.rms, lw=1.1, zorder=4, **style)


def _limit(e: np.ndarray) -> float:
    finite = np.abs(e[np.isfinite(e)])
    limit = 1.35 * float(np.quantile(finite, 0.995)) if len(finite) else 0.0
    return limit if limit > 0 else 1.0


def _thinned(index: np.ndarray) -> np.ndarray:
    return index[:: -(-len(index) // _MOST_POINTS)] if len(index) else index


def _apart(x: np.ndarray) -> np.ndarray:
    """The driver, but where it takes few values each spread a little, so that its samples do not hide each other."""
    levels = np.unique(x[np.isfinite(x)])
    if not 1 < len(levels) <= _MOST_LEVELS or len(x) <= _MOST_LEVELS:
        return x
    width = min(0.3 * np.diff(levels).min(), 0.04 * np.ptp(levels))
    return x + width * np.random.default_rng(0).uniform(-1.0, 1.0, len(x))


def _binned(x: np.ndarray, e: np.ndarray) -> _Bins:
    """By level where the driver takes few values, else in bins of equal counts."""
    fine = np.isfinite(x) & np.isfinite(e)
    x, e = x[fine], e[fine]
    if len(x) == 0:
        return _Bins(x, x, x)
    levels, group = np.unique(x, return_inverse=True)
    if len(levels) > _MOST_LEVELS:
        count = min(max(len(x) // _FEWEST_IN_A_BIN, 2), _MOST_BINS)
        edges = np.unique(np.quantile(x, np.linspace(0.0, 1.0, count + 1)))
        group = np.digitize(x, edges[1:-1])
    size = np.bincount(group)
    kept = size >= min(_FEWEST_IN_A_BIN // 2, len(x))
    each = np.maximum(size, 1)
    middle, mean, square = (np.bincount(group, v) / each for v in (x, e, e * e))
    return _Bins(middle[kept], mean[kept], np.sqrt(square[kept]))


def _mark(ax: Any, findings: Sequence[Finding]) -> None:
    for finding in findings:
        for start, end in finding.intervals:
            ax.axvspan(start, end, color=SHADE, lw=0, zorder=0)
        for moment in _onsets(finding):
            ax.axvline(moment, color=ORANGE, lw=1.2, zorder=3)
        if finding.onset_interval is not None:
            ax.axvspan(*finding.onset_interval, color=ORANGE, alpha=0.3, lw=0, zorder=2)


def _number(ax: Any, findings: Sequence[Finding]) -> None:
    """The numbers of the findings above the panel; of those too close to each other, side by side."""
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
            yield from ((moment, str(i)) for moment in _onsets(finding))
        else:
            yield from ((0.5 * (start + end), str(i)) for start, end in finding.intervals)


def _onsets(finding: Finding) -> tuple[float, ...]:
    """The moments at which it sets in."""
    return finding.moments or (() if finding.onset is None else (finding.onset,))


def _of_channel(key: str, channel: str) -> str:
    return term("picture.of_channel", name=capital(term(key)), channel=short(channel))
