"""Plots of a calibration, each on its own axes, for ``calibration.plot`` and the report."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, Protocol

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.drawing import BLUE, DARK_ORANGE, GREY, INK, ORANGE, PALE, SHADE, array, axes_or_new
from mkc_torch.calibration.coverage import NEAR_DEGREES, Coverage, nearest_axis
from mkc_torch.calibration.file import Matrix, Vector
from mkc_torch.calibration.places import numbered, places
from mkc_torch.functional import mkc_nll
from mkc_torch.recording.recording import Recording

PLANES = ("xy", "xz", "yz")
_MOST_POINTS = 20_000
"""Most points that a plot draws."""

_SHARES = 50
"""Number of interleaved parts of the samples in the search for uncovered directions."""

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

_BOX = {"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": GREY, "linewidth": 0.5, "alpha": 0.9}
_CLOSE = 5.0
"""Half range of a close view, in multiples of the robust scatter."""


class Calibrated(Protocol):
    """The interface of a calibration for plots; lengths are in ``unit``, the corrected field in ``field_unit``."""

    @property
    def unit(self) -> str: ...
    @property
    def center(self) -> Vector: ...
    @property
    def matrix(self) -> Matrix: ...
    @property
    def radius(self) -> float: ...
    @property
    def field_strength(self) -> float: ...
    @property
    def field_unit(self) -> str: ...
    @property
    def sigma(self) -> float: ...
    @property
    def d(self) -> float: ...
    @property
    def bound(self) -> float: ...
    @property
    def disturbed(self) -> Sequence[tuple[float, float]]: ...
    @property
    def coverage(self) -> Coverage: ...
    def corrected(self, points: Tensor) -> Tensor: ...
    def norm_residual(self, points: Tensor) -> Tensor: ...
    def algebraic_residual(self, points: Tensor) -> Tensor: ...
    def weight(self, points: Tensor) -> Tensor: ...


class CalibrationPlot:
    """Plots of a calibration. Each method draws on ``ax``, or on a new pyplot figure, and returns the axes.

    The samples are those of the calibration. A calibration that was read from a file has no samples: pass a
    ``recording`` to the methods. Plots need matplotlib, which the extra ``cli`` installs. An ``ax`` that is not
    matplotlib axes raises a TypeError.

    Example:
        >>> from matplotlib import pyplot
        >>> from mkc_torch.calibration import calibrate
        >>> from mkc_torch.recording import simulated_recording
        >>> recording, _ = simulated_recording()
        >>> axes = calibrate(recording).plot.residual()
        >>> axes.get_xlabel(), axes.get_ylabel()
        ('time (s)', 'residual (µT)')
        >>> pyplot.close(axes.figure)
    """

    def __init__(self, calibration: Calibrated, samples: Recording | None) -> None:
        self._calibration, self._samples = calibration, samples

    def sphere(
        self,
        plane: Literal["xy", "xz", "yz"] = "xz",
        *,
        corrected: bool = False,
        recording: Recording | None = None,
        ax: Any = None,
    ) -> Any:
        """Plot the samples near a plane through the centre, measured or corrected, and their ideal outline.

        Rejected samples are orange; samples far from the plane are pale; + is the centre.

        Args:
            plane: plane of the sensor's corrected axes.
            corrected: plot the corrected field instead of the measurements.
            recording: samples to draw; default those of the calibration.
            ax: axes of matplotlib.

        Raises:
            ValueError: an unknown plane, or no samples to draw.
        """
        if plane not in PLANES:
            raise ValueError(f"Expected argument `plane` to be one of {', '.join(PLANES)} but got {plane!r}.")
        points = self._drawn(recording).magnetometer()
        ax = axes_or_new(ax, size=(4.8, 4.8))
        draw_sphere(ax, self._calibration, points, plane, corrected=corrected)
        return ax

    def residual(self, *, close: bool = False, recording: Recording | None = None, ax: Any = None) -> Any:
        """Plot the length of the corrected field minus its nominal length over time, in the unit of the measurements.

        Rejected samples are orange, disturbed intervals shaded.

        Args:
            close: limit the axis to five times the robust scatter to either side of zero.
            recording: samples to draw; default those of the calibration.
            ax: axes of matplotlib.

        Raises:
            ValueError: no samples to draw.
        """
        samples = self._drawn(recording)
        points = samples.magnetometer()
        ax = axes_or_new(ax)
        draw_residual(ax, self._calibration, points, places(samples))
        if close:
            scatter = 1.4826 * float(self._calibration.norm_residual(points).abs().median())
            if scatter > 0.0:
                ax.set_ylim(-_CLOSE * scatter, _CLOSE * scatter)
        ax.set_title("Measured minus nominal length of the field")
        ax.set_xlabel("row of the recording" if samples.time is None else "time (s)")
        ax.legend(markerscale=4, frameon=False)
        return ax

    def weights(self, *, recording: Recording | None = None, ax: Any = None) -> Any:
        """Plot the weight in [0, 1] of each sample over time; samples below 0.5 count as rejected and are orange.

        Raises:
            ValueError: no samples to draw.
        """
        samples = self._drawn(recording)
        weight = array(self._calibration.weight(samples.magnetometer()))
        x = array(places(samples))
        ax = axes_or_new(ax)
        _shade(ax, self._calibration)
        for mask, color, label in _kinds(weight < 0.5):
            ax.plot(x[mask], weight[mask], ".", ms=2.2, color=color, label=label, rasterized=True)
        ax.set_ylim(-0.03, 1.03)
        ax.margins(x=0.01)
        ax.set_xlabel("row of the recording" if samples.time is None else "time (s)")
        ax.set_ylabel("weight")
        ax.legend(markerscale=4, frameon=False)
        return ax

    def density(self, *, tail: bool = False, recording: Recording | None = None, ax: Any = None) -> Any:
        """Plot a histogram of the residuals with the fitted density and a Gaussian of the same samples.

        Args:
            tail: show all samples on a logarithmic scale instead of the centre on a linear scale.
            recording: samples to draw; default those of the calibration.
            ax: axes of matplotlib.

        Raises:
            ValueError: no samples to draw.
        """
        points = self._drawn(recording).magnetometer()
        ax = axes_or_new(ax)
        draw_density(ax, self._calibration, points, tail=tail)
        ax.set_title("Head and tail, logarithmic scale" if tail else "Head, linear scale")
        unit = self._calibration.unit
        ax.set_ylabel(f"density (1/{unit})" if unit else "density")
        ax.legend(frameon=False)
        return ax

    def coverage(self, *, recording: Recording | None = None, ax: Any = None) -> Any:
        """Plot the directions of the field in the sensor's axes in equal-area projection; hatched areas are uncovered.

        Args:
            recording: samples to draw; default those of the calibration.
            ax: axes of matplotlib with the projection "mollweide".

        Raises:
            ValueError: no samples to draw, or the axes have another projection.
        """
        c, points = self._calibration, self._drawn(recording).magnetometer()
        ax = axes_or_new(ax, projection="mollweide", size=(7.2, 3.6))
        draw_coverage(ax, c.coverage, c.corrected(points)[c.weight(points) >= 0.5])
        ax.set_title("Directions covered")
        return ax

    def _drawn(self, recording: Recording | None) -> Recording:
        if recording is not None:
            return numbered(recording).finite("mag_x", "mag_y", "mag_z")
        if self._samples is None:
            raise ValueError(
                "A calibration that was read from a file has no samples to draw; pass its recording, as in "
                '`calibration.plot.residual(recording=Recording.read("RECORDING.csv"))`.'
            )
        return self._samples


def draw_sphere(ax: Any, c: Calibrated, points: Tensor, plane: str, *, corrected: bool) -> None:
    """Draw the samples near a plane of the sensor's corrected axes through the centre, and their ideal outline."""
    i, j = ("xyz".index(axis) for axis in plane)
    rejected = c.weight(points) < 0.5
    field = c.corrected(points)
    near = array(field[:, 3 - i - j].abs() < 0.2 * c.field_strength)
    outline = _ring(i, j) * c.field_strength
    middle, unit = (0.0, 0.0), c.field_unit
    if not corrected:  # the plane mapped back to the measurements
        outline = np.array(c.center) + outline @ np.linalg.inv(np.array(c.matrix)).T
        middle, unit = (c.center[i], c.center[j]), c.unit
    _cloud(ax, field if corrected else points, rejected, near, i, j)
    ax.plot(outline[:, i], outline[:, j], color=INK, lw=1.1)
    ax.plot(*middle, "+", color=INK, ms=9, mew=1.2)
    if not corrected:
        ax.plot(0, 0, ".", color=GREY, ms=5)
    _square(ax, outline[:, i], outline[:, j], include_origin=not corrected)
    ax.set_xlabel(f"{plane[0]} ({unit})" if unit else plane[0])
    ax.set_ylabel(f"{plane[1]} ({unit})" if unit else plane[1])
    ax.set_title(("Corrected, {plane} plane" if corrected else "Measured, {plane} plane").format(plane=plane))


def draw_residual(ax: Any, c: Calibrated, points: Tensor, place: Tensor) -> None:
    """Draw the residual of the norm over time or rows, with rejected samples and disturbed intervals marked."""
    r = array(c.norm_residual(points))
    x = array(place)
    _shade(ax, c)
    ax.axhline(0.0, color=GREY, lw=0.7)
    for mask, color, label in _kinds(array(c.weight(points) < 0.5)):
        if mask.any():
            ax.plot(x[mask], r[mask], ".", ms=2.2, color=color, label=label, rasterized=True)
    ax.margins(x=0.01)
    ax.set_ylabel(f"residual ({c.unit})" if c.unit else "residual")


def draw_density(ax: Any, c: Calibrated, points: Tensor, *, tail: bool) -> None:
    """Draw the fitted density over a histogram of the residuals: the centre, or all on a logarithmic scale."""
    half_radius = 0.5 * c.radius
    e = half_radius * c.algebraic_residual(points).double()
    d, bound = half_radius * c.d, half_radius * c.bound
    gauss = float(e.std())
    head = 6.0 * d
    start, end = (min(float(e.min()), -head), max(float(e.max()), head)) if tail else (-head, head)
    edges = np.linspace(start, end, 81 if tail else 61)
    count, _ = np.histogram(array(e), edges)
    value = count / (len(e) * np.diff(edges))
    ax.stairs(value, edges, fill=True, color=PALE, label="samples")
    grid = torch.linspace(start, end, 1201, dtype=torch.float64)
    fitted = torch.exp(-mkc_nll(grid, c.sigma, d, bound))
    normal = torch.exp(-0.5 * (grid / gauss).square()) / (gauss * (2 * np.pi) ** 0.5) if gauss > 0 else 0 * grid
    ax.plot(array(grid), array(fitted), color=BLUE, lw=1.6, label="MKC, fitted")
    ax.plot(array(grid), array(normal), color=ORANGE, lw=1.4, ls=(0, (5, 2)), label="Gaussian of the same samples")
    ax.set_xlabel(f"residual, algebraic × radius/2 ({c.unit})")
    ax.margins(x=0)
    if tail:
        least = 1.0 / (len(e) * (edges[1] - edges[0]))
        ax.set_ylim(0.3 * least, 3.0 * max(float(fitted.max()), float(value.max())))
        ax.set_yscale("log")
        # math text in labels, and minor ticks, would take as long as the rest of the plot
        ax.minorticks_off()
        ax.yaxis.set_major_formatter(lambda value, _: _decade(value))


def _decade(value: float) -> str:
    """Format a power of ten in Unicode; "" for other values.

    Example:
        >>> _decade(1e-3), _decade(100.0), _decade(2.0)
        ('10⁻³', '10²', '')
    """
    exponent = round(math.log10(value)) if value > 0.0 else 0
    return f"10{str(exponent).translate(_RAISED)}" if math.isclose(value, 10.0**exponent) else ""


def draw_coverage(ax: Any, found: Coverage, directions: Tensor) -> None:
    """Draw covered and uncovered directions on a Mollweide map, with samples, axes and gaps."""
    from matplotlib.colors import ListedColormap

    lon, lat = np.meshgrid(np.radians(np.linspace(-180, 180, 121)), np.radians(np.linspace(-90, 90, 61)))
    covered = _covered(lon, lat, directions)
    palette = ListedColormap(["#D55E002C", "#0072B232"])
    ax.pcolormesh(lon, lat, covered, cmap=palette, vmin=0, vmax=1, shading="gouraud", rasterized=True)
    if not covered.all():
        ax.contourf(lon, lat, covered, levels=[-0.5, 0.5], colors="none", hatches=["///"])
    unit = torch.nn.functional.normalize(_thinned(directions), dim=-1).numpy()
    # projected here, because matplotlib would also interpolate the undrawn lines between points, 75 times each
    place = ax.transProjection.transform(np.stack(_lon_lat(unit), -1))
    on_page = ax.transAffine + ax.transAxes
    ax.plot(*place.T, ".", ms=1.3, color=BLUE, alpha=0.6, rasterized=True, transform=on_page)
    for name, vector in (
        ("+x", (1, 0, 0)), ("+y", (0, 1, 0)), ("+z", (0, 0, 1)), ("−y", (0, -1, 0)), ("−z", (0, 0, -1)),
    ):  # fmt: skip
        _label(ax, *_lon_lat(np.array([vector], dtype=float)), name)
    for side in (-np.pi, np.pi):
        _label(ax, np.array([side]), np.array([0.0]), "−x")
    for gap in found.gaps:
        lon_gap, lat_gap = _lon_lat(np.array([gap.direction]))
        ax.plot(lon_gap, lat_gap, "x", color=ORANGE, ms=9, mew=2)
        ax.annotate(
            f"gap {nearest_axis(gap.direction).replace('-', '−')}, {gap.degrees:.0f}°",
            (float(lon_gap[0]), float(lat_gap[0])),
            xytext=(0, -9), textcoords="offset points", ha="center", va="top",
            color=DARK_ORANGE, weight="bold", bbox=_BOX,
        )  # fmt: skip
    ax.set_xticks([])
    ax.set_yticks([])


def _shade(ax: Any, c: Calibrated) -> None:
    for start, end in c.disturbed:
        ax.axvspan(start, end, color=SHADE, lw=0)


def _kinds(rejected: np.ndarray) -> tuple[tuple[np.ndarray, str, str], ...]:
    """Masks of used and rejected samples, with their colours and labels."""
    return (~rejected, BLUE, "in use"), (rejected, ORANGE, "rejected")


def _ring(i: int, j: int) -> np.ndarray:
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    ring = np.zeros((len(angle), 3))
    ring[:, i], ring[:, j] = np.cos(angle), np.sin(angle)
    return ring


def _cloud(ax: Any, points: Tensor, rejected: Tensor, near: np.ndarray, i: int, j: int) -> None:
    p, out = points.numpy(), rejected.numpy()
    step = max(len(p) // _MOST_POINTS, 1)
    size = 2.6 if near.sum() > 500 else 5.0
    ax.plot(p[~near & ~out][::step, i], p[~near & ~out][::step, j], ".", ms=1.0, color=PALE, rasterized=True)
    ax.plot(p[near & ~out, i], p[near & ~out, j], ".", ms=size, color=BLUE, alpha=0.6, mew=0, rasterized=True)
    ax.plot(p[out, i], p[out, j], ".", ms=size + 0.6, color=ORANGE, alpha=0.8, mew=0, rasterized=True)


def _square(ax: Any, x: np.ndarray, y: np.ndarray, *, include_origin: bool) -> None:
    """Set equal scales around the outline; distant rejected samples may lie outside."""
    half = 0.62 * max(np.ptp(x), np.ptp(y))
    middle = 0.5 * (x.max() + x.min()), 0.5 * (y.max() + y.min())
    if include_origin and max(abs(middle[0]), abs(middle[1])) < half:
        ax.axhline(0.0, color=PALE, lw=0.7, zorder=0)
        ax.axvline(0.0, color=PALE, lw=0.7, zorder=0)
    ax.set_xlim(middle[0] - half, middle[0] + half)
    ax.set_ylim(middle[1] - half, middle[1] + half)
    ax.set_aspect("equal")
    ax.locator_params(nbins=5)


def _thinned(points: Tensor) -> Tensor:
    return points[:: max(len(points) // _MOST_POINTS, 1)]


def _lon_lat(unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.arctan2(unit[:, 1], unit[:, 0]), np.arcsin(np.clip(unit[:, 2], -1.0, 1.0))


def _covered(lon: np.ndarray, lat: np.ndarray, directions: Tensor) -> np.ndarray:
    grid = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], -1).reshape(-1, 3)
    unit = torch.nn.functional.normalize(_thinned(directions).float(), dim=-1)
    places, least = torch.from_numpy(grid).float(), float(np.cos(np.radians(NEAR_DEGREES)))
    uncovered = torch.arange(len(grid))
    # a few samples from the whole recording cover most directions; the rest is compared with the other samples
    for first in range(min(_SHARES, len(unit))):
        for part in unit[first::_SHARES].split(256):  # parts that fit into the cache
            uncovered = uncovered[~((places[uncovered] @ part.mT).amax(-1) > least)]
    covered = np.ones(len(grid))
    covered[uncovered.numpy()] = 0.0
    return covered.reshape(lon.shape)


def _label(ax: Any, lon: np.ndarray, lat: np.ndarray, text: str) -> None:
    ax.text(float(lon[0]), float(lat[0]), text, ha="center", va="center", fontsize=10, weight="bold", bbox=_BOX)
