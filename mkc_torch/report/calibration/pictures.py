"""The pictures of a calibration report, as inline SVG: text stays text, clouds of samples are bitmaps within."""

from __future__ import annotations

from typing import Any

import matplotlib
from matplotlib.figure import Figure
from torch import Tensor

from mkc_torch._support.drawing import STYLE
from mkc_torch._words.terms import term
from mkc_torch.calibration.calibrate import Calibration
from mkc_torch.calibration.coverage import Coverage
from mkc_torch.calibration.plot import PLANES, draw_coverage, draw_density, draw_residual, draw_sphere
from mkc_torch.report.drawing import svg

# fixed margins and title heights: a layout that measures every text takes as long as the drawing
_STYLE = STYLE | {"axes.titley": 1.0, "axes.titlepad": 5.0}
_LEFT = 0.095  # room for six digits and a sign, as of counts
_RIGHT = 0.975


def sphere(calibration: Calibration, points: Tensor) -> str:
    """Samples near each plane through the centre, measured and corrected, with the outline they should lie on."""
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(10.0, 7.1))
        figure.subplots_adjust(left=_LEFT, right=_RIGHT, bottom=0.075, top=0.955, wspace=0.38, hspace=0.3)
        for row, corrected in zip(figure.subplots(2, 3), (False, True), strict=True):
            for ax, plane in zip(row, PLANES, strict=True):
                draw_sphere(ax, calibration, points, plane, corrected=corrected)
        return svg(figure, "sphere", term("picture.about_sphere"))


def residual(calibration: Calibration, points: Tensor, place: Tensor) -> str:
    """Residual of the norm over time, or over rows: all of it above, close up below."""
    c = calibration
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(10.0, 4.8))
        figure.subplots_adjust(left=_LEFT, right=_RIGHT, bottom=0.105, top=0.93, hspace=0.24)
        top, close = figure.subplots(2, 1, sharex=True)
        for ax in (top, close):
            draw_residual(ax, c, points, place)
        limit = 5.0 * c.after.robust
        if limit > 0:
            close.set_ylim(-limit, limit)
        top.set_title(term("picture.all_samples"))
        close.set_title(term("picture.close_up", limit=f"{limit:.3g}", unit=c.unit))
        close.set_xlabel(term("picture.row" if c.disturbed_unit == "row" else "picture.time"))
        _legend_above(top)
        return svg(figure, "residual", term("picture.about_residual"))


def density(calibration: Calibration, points: Tensor) -> str:
    """The fitted density over a histogram of the residuals, linear close up and logarithmic over all."""
    unit = calibration.unit
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(10.0, 3.9))
        figure.subplots_adjust(left=_LEFT, right=_RIGHT, bottom=0.13, top=0.92, wspace=0.18)
        left, right = figure.subplots(1, 2)
        draw_density(left, calibration, points, tail=False)
        draw_density(right, calibration, points, tail=True)
        left.set_ylabel(term("picture.density", unit=unit) if unit else term("noise.density"))
        left.set_title(term("picture.head"))
        right.set_title(term("picture.tail"))
        left.legend(loc="upper left", fontsize=9, borderaxespad=0.2, handlelength=1.6)
        left.set_ylim(0.0, 1.45 * left.get_ylim()[1])
        return svg(figure, "density", term("picture.about_density"))


def coverage_map(found: Coverage, directions: Tensor) -> str:
    """The sphere of directions in the sensor's axes, Mollweide: covered, not covered, samples, axes and gaps."""
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(10.0, 4.6))
        figure.subplots_adjust(left=0.06, right=0.94, bottom=0.02, top=0.98)
        draw_coverage(figure.add_subplot(projection="mollweide"), found, directions)
        return svg(figure, "coverage", term("picture.about_coverage"))


def _legend_above(ax: Any) -> None:
    place = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.1}
    ax.legend(ncols=2, markerscale=4, handletextpad=0.1, **place)
