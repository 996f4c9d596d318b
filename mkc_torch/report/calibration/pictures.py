"""The pictures of a calibration report, as inline SVG: text stays text, clouds of samples are bitmaps within."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from mkc_torch.calibration.calibrate import Calibration
from mkc_torch.calibration.coverage import NEAR_DEGREES, Coverage, nearest_axis
from mkc_torch.functional import mkc_nll
from mkc_torch.report.drawing import BLUE, GREY, INK, ORANGE, PALE, SHADE, STYLE, svg
from mkc_torch.report.words.terms import term

_MOST_POINTS = 20_000
_BOX = {"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": GREY, "linewidth": 0.5, "alpha": 0.9}


def sphere(calibration: Calibration, points: Tensor) -> str:
    """Samples near each plane through the centre, measured and corrected, with the outline they should lie on."""
    c = calibration
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(10.0, 6.9), layout="constrained")
        axes = figure.subplots(2, 3)
        rejected = c.weight(points) < 0.5
        before, after = points, c.corrected(points)
        center = np.array(c.center)
        distortion = np.linalg.inv(np.array(c.matrix))
        for column, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
            k = 3 - i - j
            ring = _ring(i, j) * c.field_strength
            near = (after[:, k].abs() < 0.2 * c.field_strength).numpy()
            # the plane of the sensor's corrected axes, carried back to what was measured
            measured = center + ring @ distortion.T
            name = "xyz"
            _cloud(axes[0, column], before, rejected, near, i, j)
            axes[0, column].plot(measured[:, i], measured[:, j], color=INK, lw=1.1)
            axes[0, column].plot(c.center[i], c.center[j], "+", color=INK, ms=9, mew=1.2)
            axes[0, column].plot(0, 0, ".", color=GREY, ms=5)
            _cloud(axes[1, column], after, rejected, near, i, j)
            axes[1, column].plot(ring[:, i], ring[:, j], color=INK, lw=1.1)
            axes[1, column].plot(0, 0, "+", color=INK, ms=9, mew=1.2)
            for row, (unit, outline) in enumerate(((c.unit, measured), (c.field_unit, ring))):
                ax = axes[row, column]
                _square(ax, outline[:, i], outline[:, j], include_origin=row == 0)
                ax.set_xlabel(f"{name[i]} ({unit})")
                ax.set_ylabel(f"{name[j]} ({unit})")
                ax.set_title(term("picture.measured" if row == 0 else "picture.corrected", plane=name[i] + name[j]))
        return svg(figure, "sphere", term("picture.about_sphere"))


def residual(calibration: Calibration, points: Tensor, place: Tensor) -> str:
    """Residual of the norm over time, or over rows: all of it above, close up below."""
    c = calibration
    r = c.norm_residual(points).numpy()
    rejected = (c.weight(points) < 0.5).numpy()
    x = place.numpy()
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(10.0, 4.8), layout="constrained")
        top, close = figure.subplots(2, 1, sharex=True)
        for ax in (top, close):
            for start, end in c.disturbed:
                ax.axvspan(start, end, color=SHADE, lw=0)
            ax.axhline(0.0, color=GREY, lw=0.7)
            for mask, color, label in ((~rejected, BLUE, "picture.in_use"), (rejected, ORANGE, "label.rejected")):
                if mask.any():
                    ax.plot(x[mask], r[mask], ".", ms=2.2, color=color, label=term(label), rasterized=True)
            ax.set_ylabel(f"{term('label.residual')} ({c.unit})")
        limit = 5.0 * c.after.robust
        if limit > 0:
            close.set_ylim(-limit, limit)
        top.set_title(term("picture.all_samples"))
        close.set_title(term("picture.close_up", limit=f"{limit:.3g}", unit=c.unit))
        close.set_xlabel(term("picture.row" if c.disturbed_unit == "row" else "picture.time"))
        close.margins(x=0.01)
        _legend_above(top)
        return svg(figure, "residual", term("picture.about_residual"))


def density(calibration: Calibration, points: Tensor) -> str:
    """The fitted density over a histogram of the residuals, linear close up and logarithmic over all."""
    c = calibration
    half_radius = 0.5 * c.radius
    e = half_radius * c.algebraic_residual(points).double()
    d, bound = half_radius * c.d, half_radius * c.bound
    gauss = float(e.std())
    low, high = float(e.min()), float(e.max())
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(10.0, 3.9), layout="constrained")
        left, right = figure.subplots(1, 2)
        head = 6.0 * d
        for ax, start, end in ((left, -head, head), (right, min(low, -head), max(high, head))):
            edges = np.linspace(start, end, 61 if ax is left else 81)
            count, _ = np.histogram(e.numpy(), edges)
            value = count / (len(e) * np.diff(edges))
            ax.stairs(value, edges, fill=True, color=PALE, label=term("picture.samples"))
            grid = torch.linspace(start, end, 1201, dtype=torch.float64)
            fitted = torch.exp(-mkc_nll(grid, c.sigma, d, bound))
            normal = torch.exp(-0.5 * (grid / gauss).square()) / (gauss * (2 * np.pi) ** 0.5) if gauss > 0 else 0 * grid
            ax.plot(grid, fitted, color=BLUE, lw=1.6, label=term("picture.fitted"))
            ax.plot(grid, normal, color=ORANGE, lw=1.4, ls=(0, (5, 2)), label=term("picture.normal"))
            ax.set_xlabel(term("picture.algebraic", unit=c.unit))
            ax.margins(x=0)
            if ax is right:
                least = 1.0 / (len(e) * (edges[1] - edges[0]))
                ax.set_ylim(0.3 * least, 3.0 * max(float(fitted.max()), float(value.max())))
                ax.set_yscale("log")
        left.set_ylabel(term("picture.density", unit=c.unit) if c.unit else term("noise.density"))
        left.set_title(term("picture.head"))
        right.set_title(term("picture.tail"))
        left.legend(loc="upper left", fontsize=9, borderaxespad=0.2, handlelength=1.6)
        left.set_ylim(0.0, 1.45 * left.get_ylim()[1])
        return svg(figure, "density", term("picture.about_density"))


def coverage_map(found: Coverage, directions: Tensor) -> str:
    """The sphere of directions in the sensor's axes, Mollweide: covered, not covered, samples, axes and gaps."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(10.0, 4.6), layout="constrained")
        ax: Any = figure.add_subplot(projection="mollweide")
        lon, lat = np.meshgrid(np.radians(np.linspace(-180, 180, 121)), np.radians(np.linspace(-90, 90, 61)))
        covered = _covered(lon, lat, directions)
        ax.set_facecolor("#FFFFFF")
        palette = matplotlib.colors.ListedColormap(["#F6E3D5", "#CFE3F0"])
        ax.pcolormesh(lon, lat, covered, cmap=palette, vmin=0, vmax=1, shading="gouraud", rasterized=True)
        if not covered.all():
            ax.contourf(lon, lat, covered, levels=[-0.5, 0.5], colors="none", hatches=["///"])
        unit = torch.nn.functional.normalize(_thinned(directions), dim=-1).numpy()
        # projected here, or the lines between them, which nobody draws, would be projected too, at 75 places each
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
                term("picture.gap", axis=nearest_axis(gap.direction).replace("-", "−"), degrees=f"{gap.degrees:.0f}"),
                (float(lon_gap[0]), float(lat_gap[0])),
                xytext=(0, -9), textcoords="offset points", ha="center", va="top",
                color="#9A4300", weight="bold", bbox=_BOX,
            )  # fmt: skip
        ax.set_xticks([])
        ax.set_yticks([])
        return svg(figure, "coverage", term("picture.about_coverage"))


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
    """Equal scales around the outline; rejected samples far away would shrink it, so they may lie outside."""
    half = 0.62 * max(np.ptp(x), np.ptp(y))
    middle = 0.5 * (x.max() + x.min()), 0.5 * (y.max() + y.min())
    if include_origin and max(abs(middle[0]), abs(middle[1])) < half:
        ax.axhline(0.0, color=PALE, lw=0.7, zorder=0)
        ax.axvline(0.0, color=PALE, lw=0.7, zorder=0)
    ax.set_xlim(middle[0] - half, middle[0] + half)
    ax.set_ylim(middle[1] - half, middle[1] + half)
    ax.set_aspect("equal")
    ax.xaxis.set_major_locator(matplotlib.ticker.MaxNLocator(5))
    ax.yaxis.set_major_locator(matplotlib.ticker.MaxNLocator(5))


def _legend_above(ax: Any) -> None:
    place = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.1}
    ax.legend(ncols=2, markerscale=4, handletextpad=0.1, **place)


def _thinned(points: Tensor) -> Tensor:
    return points[:: max(len(points) // _MOST_POINTS, 1)]


def _lon_lat(unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.arctan2(unit[:, 1], unit[:, 0]), np.arcsin(np.clip(unit[:, 2], -1.0, 1.0))


def _covered(lon: np.ndarray, lat: np.ndarray, directions: Tensor) -> np.ndarray:
    grid = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], -1).reshape(-1, 3)
    unit = torch.nn.functional.normalize(_thinned(directions).float(), dim=-1)
    nearest = torch.full((len(grid),), -1.0)
    for part in unit.split(256):  # what is compared stays in the cache
        nearest = torch.maximum(nearest, (torch.from_numpy(grid).float() @ part.mT).amax(-1))
    return (nearest.numpy() > np.cos(np.radians(NEAR_DEGREES))).astype(float).reshape(lon.shape)


def _label(ax: Any, lon: np.ndarray, lat: np.ndarray, text: str) -> None:
    ax.text(float(lon[0]), float(lat[0]), text, ha="center", va="center", fontsize=10, weight="bold", bbox=_BOX)
