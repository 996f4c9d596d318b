"""Residual over time or over a driver: samples, their mean and RMS, and the times of findings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mkc_torch._support.drawing import BLUE, GREY, INK, ORANGE, SHADE, array
from mkc_torch._support.typesetting import capital
from mkc_torch.diagnosis.environment import NoiseEnvironment
from mkc_torch.diagnosis.parts import Finding, Traces
from mkc_torch.diagnosis.plot.curves import named, short, units_of_outputs

MOMENTS = ("before", "after")
_USED, _REJECTED = "#7FB8DA", "#F2C7AA"
_MOST_POINTS = 5_000  # of a panel
_MOST_BINS, _FEWEST_IN_A_BIN = 60, 12
"""Number of bins over a driver, and minimum number of samples per bin."""

_MOST_LEVELS = 24  # of a driver that takes few values, such as a switch


@dataclass(frozen=True)
class _Bins:
    """Mean and RMS of the samples in use, by bins of a driver."""

    x: np.ndarray
    mean: np.ndarray
    rms: np.ndarray


def draw_residuals(axes: Sequence[Any], t: Traces, x: np.ndarray, channel: int, unit: str) -> None:
    """Draw the residual before and, on the second axes, after."""
    for ax, after in zip(axes, (False, True), strict=False):
        draw_residual(ax, t, x, channel, unit, after=after)


def draw_residual(ax: Any, t: Traces, x: np.ndarray, channel: int, unit: str, *, after: bool) -> None:
    """Draw samples, and mean and RMS of the samples in use; with ``after``, also the RMS before."""
    before, used = array(t.before[:, channel]), array(t.weight[:, channel]) >= 0.5
    limit, earlier, shown = _limit(before[used]), _binned(x[used], before[used]), _apart(x)
    marker = "o" if len(earlier.x) <= _MOST_LEVELS else ""
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
    change = (t.before - t.after).nan_to_num().square().sum(0).tolist()
    return sorted(acting, key=lambda i: -change[i])
