"""The style of all plots, and their axes."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from torch import Tensor

# Okabe and Ito's colours, distinguishable with any colour vision
BLUE, ORANGE, INK, GREY = "#0072B2", "#D55E00", "#222222", "#8A8A8A"
DARK_ORANGE = "#9A4300"
# translucent, for pages with a light or a dark background
PALE, SHADE = "#5A708040", "#D55E0038"
STYLE = {
    "font.family": "sans-serif",
    "font.size": 10.0,
    "axes.edgecolor": GREY,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
    "text.color": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "axes.unicode_minus": True,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "hatch.color": "#D9B79D",
    "hatch.linewidth": 0.7,
    "legend.frameon": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "mkc",
    "savefig.transparent": True,
}
# names from files may contain a dollar sign; a fixed title height saves a layout pass for every panel
_OF_NAMES = {"text.parse_math": False, "axes.titley": 1.0, "axes.titlesize": 10.0, "axes.titlepad": 5.0}
_SIZE = (6.4, 4.0)
"""Size of a figure in inches."""


@contextmanager
def style() -> Iterator[None]:
    """Apply the style of all plots within the block."""
    import matplotlib

    with matplotlib.rc_context(STYLE | _OF_NAMES), warnings.catch_warnings():
        # names may contain letters that the font for the layout lacks; the browser of the reader has them
        warnings.filterwarnings("ignore", message="Glyph .* missing from", category=UserWarning)
        yield


def axes_or_new(ax: Any = None, *, projection: str | None = None, size: tuple[float, float] = _SIZE) -> Any:
    """The given axes, or the axes of a new pyplot figure, which a notebook shows and ``plt.show()`` opens.

    Args:
        ax: axes of matplotlib, or None.
        projection: required projection of the axes, such as "mollweide".
        size: size of a new figure in inches.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
        TypeError: ``ax`` is not axes.
        ValueError: the axes have another projection.
    """
    try:
        from matplotlib import pyplot
        from matplotlib.axes import Axes
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "A picture needs matplotlib: pip install 'mkc-torch[cli]'.", name="matplotlib"
        ) from error
    if ax is None:
        with style():
            return pyplot.figure(figsize=size, layout="constrained").add_subplot(projection=projection)
    if not isinstance(ax, Axes):
        raise TypeError(f"Expected argument `ax` to be axes of matplotlib or None but got {type(ax).__name__}.")
    if projection is not None and ax.name != projection:
        raise ValueError(
            f"Expected argument `ax` to have the projection {projection!r} but got {ax.name!r}; make it with "
            f"figure.add_subplot(projection={projection!r}), or leave it out."
        )
    return ax


def array(values: Tensor) -> np.ndarray:
    """A tensor as a NumPy array, for a plot."""
    return values.detach().cpu().numpy()
