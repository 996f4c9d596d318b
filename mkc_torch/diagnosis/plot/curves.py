"""Curves of effects, disturbances over time, maps of gains, and labels of axes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mkc_torch._support.drawing import BLUE, GREY, INK, ORANGE, array
from mkc_torch._support.typesetting import plain
from mkc_torch._support.unit_text import tidy
from mkc_torch.diagnosis.environment import Curve, DisturbanceEstimate, NoiseEnvironment
from mkc_torch.diagnosis.parts import StateMap

CURVE_COLORS = (BLUE, ORANGE, "#009E73", "#A8558A", "#B58900", INK)
MOST_LETTERS = 26
"""Letters of a name in a figure; longer names are cut."""

_MOST_POINTS = 2_000
"""Largest number of points of a line; longer series are thinned."""

_GAP = 5.0
"""Gap, in median steps, across which samples are not joined."""
_NEVER = "#E3E3E3"


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
    step = max(-(-len(time) // _MOST_POINTS), 1)
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
