"""The pictures of a calibration report, as inline SVG: text stays text, clouds of samples are bitmaps within."""

from __future__ import annotations

import matplotlib
from torch import Tensor

from mkc_torch._support.drawing import STYLE
from mkc_torch.calibration.calibrate import Calibration
from mkc_torch.calibration.coverage import Coverage
from mkc_torch.calibration.plot import PLANES, draw_coverage, draw_density, draw_residual, draw_sphere
from mkc_torch.report.panels import Margins, Panels

# fixed margins and title heights: a layout that measures every text takes as long as the drawing
_STYLE = STYLE | {"axes.titley": 1.0, "axes.titlepad": 5.0}
_MARGINS = Margins(left=0.95)  # room for six digits and a sign, as of counts


def sphere(calibration: Calibration, points: Tensor) -> str:
    """Samples near each plane through the centre, measured and corrected, with the outline they should lie on."""
    panels = Panels(3, height=2.18, margins=_MARGINS)
    with matplotlib.rc_context(_STYLE):
        for corrected in (False, True):
            for plane in PLANES:
                draw_sphere(panels.axes(), calibration, points, plane, corrected=corrected)
        return panels.markup("sphere", "Samples before and after calibration in three planes, with the fitted outline")


def residual(calibration: Calibration, points: Tensor, place: Tensor) -> str:
    """Residual of the norm over time, or over rows: all of it, and close up."""
    c = calibration
    panels = Panels(2, height=2.3, margins=_MARGINS)
    with matplotlib.rc_context(_STYLE):
        whole, close = panels.axes(), panels.axes()
        for ax in (whole, close):
            draw_residual(ax, c, points, place)
            ax.set_xlabel("row of the recording" if c.disturbed_unit == "row" else "time (s)")
        limit = 5.0 * c.after.robust
        if limit > 0:
            close.set_ylim(-limit, limit)
        whole.set_title("All samples")
        close.set_title("Close up: five times the robust scatter")
        return panels.markup("residual", "Residual over time with rejected samples and disturbed intervals")


def density(calibration: Calibration, points: Tensor) -> str:
    """The fitted density over a histogram of the residuals, linear close up and logarithmic over all."""
    unit = calibration.unit
    panels = Panels(2, height=2.8, margins=_MARGINS)
    with matplotlib.rc_context(_STYLE):
        for tail in (False, True):
            ax = panels.axes()
            draw_density(ax, calibration, points, tail=tail)
            ax.set_ylabel(f"density (1/{unit})" if unit else "density")
            ax.set_title("Head and tail, logarithmic scale" if tail else "Head, linear scale")
            if not tail:
                ax.legend(loc="upper left", fontsize=9, borderaxespad=0.2, handlelength=1.6)
                ax.set_ylim(0.0, 1.45 * ax.get_ylim()[1])
        return panels.markup("density", "Histogram of residuals with the MKC density and a Gaussian")


def coverage_map(found: Coverage, directions: Tensor) -> str:
    """The sphere of directions in the sensor's axes, Mollweide: covered, not covered, samples, axes and gaps."""
    panels = Panels(1, height=3.0, margins=Margins(left=0.2, right=0.2, top=0.1, bottom=0.1))
    with matplotlib.rc_context(_STYLE):
        draw_coverage(panels.axes(projection="mollweide"), found, directions)
        return panels.markup("coverage", "Map of the directions covered and not covered, in the sensor's axes")
