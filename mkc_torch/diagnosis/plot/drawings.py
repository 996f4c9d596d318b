"""Drawings of residuals and of effects' curves on axes of matplotlib."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from mkc_torch._support.drawing import BLUE, GREY, INK, ORANGE, SHADE, array
from mkc_torch._support.typesetting import capital, plain
from mkc_torch._support.unit_text import tidy
from mkc_torch.diagnosis.environment import Curve, DisturbanceEstimate, NoiseEnvironment
from mkc_torch.diagnosis.parts import Finding, StateMap, Traces
from mkc_torch.diagnosis.vetoes import counts

MOMENTS = ("before", "after")

_USED, _REJECTED = "#7FB8DA", "#F2C7AA"

_MOST_POINTS = 5_000  # of a panel

_MOST_BINS, _FEWEST_IN_A_BIN = 60, 12
"""Number of bins over a driver, and minimum number of samples per bin."""

_MOST_LEVELS = 24  # of a driver that takes few values, such as a switch

CURVE_COLORS = (BLUE, ORANGE, "#009E73", "#A8558A", "#B58900", INK)

MOST_LETTERS = 26
"""Letters of a name in a figure; longer names are cut."""

_CURVE_POINTS = 2_000
"""Largest number of points of a line; longer series are thinned."""

_GAP = 5.0
"""Gap, in median steps, across which samples are not joined."""

_NEVER = "#E3E3E3"


@dataclass(frozen=True)
class _Bins:
    """Mean and RMS of the samples in use, by bins of a driver."""

    x: np.ndarray
    mean: np.ndarray
    rms: np.ndarray


def draw_residuals(
    axes: Sequence[Any], t: Traces, x: np.ndarray, channel: int, unit: str, finding: Finding | None = None
) -> None:
    """Draw the residual before and, on the second axes, after."""
    for ax, after in zip(axes, (False, True), strict=False):
        draw_residual(ax, t, x, channel, unit, after=after, finding=finding)


def residual_after(t: Traces, finding: Finding | None = None) -> Tensor:
    """Return the residual with the findings that count, (N, m); of a finding that does not count, with all."""
    return t.after if finding is None or counts(finding) or t.with_all is None else t.with_all


def draw_residual(
    ax: Any, t: Traces, x: np.ndarray, channel: int, unit: str, *, after: bool, finding: Finding | None = None
) -> None:
    """Draw samples, and mean and RMS of the samples in use; with ``after``, also the RMS before.

    ``finding`` is one whose effect the residual after includes; None for that of all findings that count.
    """
    before, used = array(t.before[:, channel]), array(t.weight[:, channel]) >= 0.5
    limit, earlier, shown = _limit(before[used]), _binned(x[used], before[used]), _apart(x)
    marker = "o" if len(earlier.x) <= _MOST_LEVELS else ""
    e = array(residual_after(t, finding)[:, channel]) if after else before
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
    ax.set_ylabel(named("residual", unit))


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
    """Jitter a driver with few values, so that its samples do not overlap."""
    levels = np.unique(x[np.isfinite(x)])
    if not 1 < len(levels) <= _MOST_LEVELS or len(x) <= _MOST_LEVELS:
        return x
    width = min(0.3 * np.diff(levels).min(), 0.04 * np.ptp(levels))
    return x + width * np.random.default_rng(0).uniform(-1.0, 1.0, len(x))


def _binned(x: np.ndarray, e: np.ndarray) -> _Bins:
    """Bin by value for a driver with few values, otherwise by equal counts."""
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


def mark_findings(ax: Any, findings: Sequence[Finding]) -> None:
    for finding in findings:
        for start, end in finding.intervals:
            ax.axvspan(start, end, color=SHADE, lw=0, zorder=0)
        for moment in onsets(finding):
            ax.axvline(moment, color=ORANGE, lw=1.2, zorder=3)
        if finding.onset_interval is not None:
            ax.axvspan(*finding.onset_interval, color=ORANGE, alpha=0.3, lw=0, zorder=2)


def mark_rejected(ax: Any, intervals: Sequence[tuple[float, float]]) -> None:
    """Shade the intervals in which most samples were rejected."""
    for start, end in intervals:
        ax.axvspan(start, end, color=ORANGE, alpha=0.18, lw=0, zorder=0)


def onsets(finding: Finding) -> tuple[float, ...]:
    """Return the onsets of a finding."""
    return finding.event_times or (() if finding.onset is None else (finding.onset,))


def draw_floor(ax: Any, size: float | None) -> None:
    """Draw the noise floor on both sides of zero."""
    for side in (-1.0, 1.0) if size is not None and math.isfinite(size) else ():
        ax.axhline(side * (size or 0.0), color=GREY, lw=1.1, ls=":", zorder=6)


def unit_of_channel(t: Traces, environment: NoiseEnvironment, channel: int) -> str:
    """Return the unit of a channel: that of all channels, or of the output with its name; empty if unknown."""
    return t.unit or units_of_outputs(environment).get(t.channels[channel], "")


def of_channel(key: str, channel: str) -> str:
    return f"{capital(key)}, {short(channel)}"


def acting_channels(t: Traces, finding: Finding) -> list[int]:
    """Return the channels of a finding, the largest change first."""
    acting = [i for i, name in enumerate(t.channels) if name in finding.channels] or list(range(len(t.channels)))
    change = (t.before - residual_after(t, finding)).nan_to_num().square().sum(0).tolist()
    return sorted(acting, key=lambda i: -change[i])


def draw_curve(ax: Any, curve: Curve, has_time: bool, most: int = MOST_LETTERS) -> None:
    """Draw a curve with its band over its driver, one colour per channel."""
    x, value, band = array(curve.x), array(curve.value), array(curve.band)
    ax.axhline(0.0, color=GREY, lw=0.7, zorder=1)
    for i in range(value.shape[1]):
        color = CURVE_COLORS[i % len(CURVE_COLORS)]
        label = short(curve.channels[i]) if i < len(curve.channels) else None
        ax.fill_between(x, value[:, i] - band[:, i], value[:, i] + band[:, i], color=color, alpha=0.18, lw=0)
        ax.plot(x, value[:, i], color=color, lw=1.6, label=label)
    ax.margins(x=0.01)
    sampled = curve.driver == "time" and not has_time
    ax.set_xlabel("sample" if sampled else named(curve.driver, curve.unit, most))
    ax.set_ylabel(named("effect", curve.value_unit))
    ax.locator_params(axis="x", nbins=6)
    ax.locator_params(axis="y", nbins=5)


def draw_course(ax: Any, estimate: DisturbanceEstimate, has_time: bool) -> None:
    """Draw a disturbance over time with its band."""
    course = array(estimate.time)
    time, value, band = (_joined(course, array(series)) for series in (estimate.time, estimate.value, estimate.band))
    ax.axhline(0.0, color=GREY, lw=0.7, zorder=1)
    ax.fill_between(time, value - band, value + band, color=BLUE, alpha=0.2, lw=0, zorder=2)
    ax.plot(time, value, color=BLUE, lw=1.2, zorder=3)
    ax.margins(x=0.01)
    ax.set_xlabel(of_time(has_time))
    ax.set_ylabel(short(tidy(estimate.unit)))
    ax.locator_params(axis="y", nbins=5)
    key = "Disturbance of the rate of {place}, 95 % band" if estimate.at_rate else "Drift of {place}, 95 % band"
    ax.set_title(key.format(place=short(estimate.place)))


def _joined(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Thin a long series, and break the line between runs."""
    step = max(-(-len(time) // _CURVE_POINTS), 1)
    time, values = time[::step], values[::step].astype(float)
    steps = np.diff(time)
    if not len(steps):
        return values
    apart = np.flatnonzero((steps <= 0.0) | (steps > _GAP * np.median(steps))) + 1
    return np.insert(values, apart, np.nan)


def units_of_outputs(environment: NoiseEnvironment) -> dict[str, str]:
    """Return the known units of outputs, by name."""
    return {fit.output: tidy(fit.unit) for fit in environment.goodness_of_fit if fit.unit}


def draw_map(ax: Any, found: StateMap, units: Mapping[str, str], colorbar_axes: Any = None) -> None:
    """Draw gains and losses in nats over two states, with a colour bar on ``colorbar_axes`` or next to the map.

    ``units`` are those of outputs, for states that are measured.
    """
    from matplotlib.colors import LinearSegmentedColormap

    # figures are transparent, so a background colour would be lost
    gain = LinearSegmentedColormap.from_list("gain", [ORANGE, "#FFFFFF", BLUE]).with_extremes(bad=_NEVER)
    nats = array(found.nats)
    shown = np.sign(nats) * np.sqrt(np.abs(nats))  # square root: a few cells have most of the gain
    limit = float(np.nanmax(np.abs(shown)))
    x, y = (array(edge) for edge in found.edges)
    drawn = ax.pcolormesh(x, y, shown.T, cmap=gain, vmin=-limit, vmax=limit, rasterized=True)
    for axis, name, unit in zip((ax.xaxis, ax.yaxis), found.states, found.units, strict=True):
        axis.set_label_text(named(name, unit or units.get(name, "")))
    ax.set_title("Gain over the states")
    bar = ax.figure.colorbar(drawn, cax=colorbar_axes, ax=None if colorbar_axes is not None else ax)
    bar.ax.set_ylim(min(0.0, float(np.nanmin(shown))), limit)
    ticks = [tick for tick in bar.get_ticks() if bar.ax.get_ylim()[0] <= tick <= limit]
    bar.set_ticks(ticks, labels=[_gain(np.sign(tick) * tick**2) for tick in ticks])
    bar.ax.set_ylabel("nats")


def _gain(nats: float) -> str:
    """Format the label of a colour bar.

    Example:
        >>> _gain(-1600.0), _gain(0.25)
        ('−1,600', '0.25')
    """
    return (f"{nats:,.0f}" if abs(nats) >= 100.0 else f"{nats:.3g}").replace("-", "−")


def of_time(has_time: bool) -> str:
    """Return the label of a time axis."""
    return "time (s)" if has_time else "sample"


def named(name: str, unit: str, most: int = MOST_LETTERS) -> str:
    """Return the label of an axis: name and unit."""
    return f"{short(name, most)} ({short(unit)})" if unit else short(name, most)


def short(text: str, most: int = MOST_LETTERS) -> str:
    """Cut a text from a file to ``most`` letters."""
    label = plain(text)
    return label if len(label) <= most else label[: most - 1] + "…"
