"""How every picture looks, and the axes that it is drawn on."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from torch import Tensor

__all__ = ["BLUE", "GREY", "INK", "ORANGE", "PALE", "SHADE", "STYLE", "array", "axes_or_new", "style"]

# Okabe and Ito's colours, told apart with any colour vision
BLUE, ORANGE, INK, GREY, PALE = "#0072B2", "#D55E00", "#222222", "#8A8A8A", "#D7DEE4"
SHADE = "#F3D9C6"
STYLE = {
    "font.family": "sans-serif",
    "font.size": 10.0,
    "axes.edgecolor": GREY,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
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
# a name from a file may hold a dollar sign; a title of given height spares a layout of every panel
_OF_NAMES = {"text.parse_math": False, "axes.titley": 1.0, "axes.titlesize": 10.0, "axes.titlepad": 5.0}
_SIZE = (6.4, 4.0)  # inches


@contextmanager
def style() -> Iterator[None]:
    """The looks of all pictures, while one is drawn."""
    import matplotlib

    with matplotlib.rc_context(STYLE | _OF_NAMES), warnings.catch_warnings():
        # names in letters that the font for measuring lacks; the reader's browser has them
        warnings.filterwarnings("ignore", message="Glyph .* missing from", category=UserWarning)
        yield


def axes_or_new(ax: Any = None, *, projection: str | None = None, size: tuple[float, float] = _SIZE) -> Any:
    """The axes, or those of a new figure of pyplot, which a notebook shows and ``plt.show()`` opens.

    Args:
        ax: matplotlib's, or None.
        projection: that the axes must have, such as "mollweide".
        size: of a new figure, in inches.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
        TypeError: what is given is no axes.
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
    """Numbers to draw."""
    return values.detach().cpu().numpy()
