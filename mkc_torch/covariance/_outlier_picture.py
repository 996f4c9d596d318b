"""Drawing of an outlier map."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

try:
    from matplotlib import pyplot
    from matplotlib.transforms import ScaledTranslation
except ImportError as error:
    raise ImportError('The outlier map is drawn with matplotlib; `pip install "mkc-torch[cli]"` has it.') from error

from mkc_torch.covariance._picture_labels import Box, free_place, linked_groups, ranges

if TYPE_CHECKING:
    from jaxtyping import Float, Int

# Okabe and Ito's colours, distinguishable with any colour vision, and marker shapes; in the order of SampleKind
_STYLES = (
    ("regular", "#8A8A8A", "o"),
    ("vertical outlier", "#0072B2", "^"),
    ("good leverage point", "#009E73", "s"),
    ("bad leverage point", "#D55E00", "D"),
)
_INK, _LINE = "#222222", "#8A8A8A"
_LETTERS = 8.0
"""Size of a label, in points."""


class PlotCoordinates(NamedTuple):
    """Coordinates of the samples of a problem: x the distances, y the residuals."""

    x: Float[Tensor, N]
    y: Float[Tensor, N]
    kind: Int[Tensor, N]
    x_cutoff: float
    y_cutoff: float


def draw(places: PlotCoordinates, ax: Any, labels: int) -> Any:
    """Draw the map of a problem into axes, or a new figure for None, and return the axes."""
    if ax is None:
        _, ax = pyplot.subplots(figsize=(7.0, 4.5), layout="constrained")
    x, y, kinds = places.x, places.y, places.kind
    for kind, (name, colour, marker) in enumerate(_STYLES):
        mine = kinds == kind
        text = f"{int(mine.sum())} {name}{'s' if kind and int(mine.sum()) != 1 else ''}"
        ax.scatter(x[mine].numpy(), y[mine].numpy(), s=20, c=colour, marker=marker, linewidths=0, zorder=3, label=text)
    _limit(places, ax)
    _tint(places, ax)
    _label(places, ax, labels)
    ax.set_xlabel("robust distance of the predictors")
    ax.set_ylabel("standardised residual")
    # below the label of the axis, clear of a title
    below = ax.transAxes + ScaledTranslation(0.0, -0.45, ax.figure.dpi_scale_trans)
    wide = ax.get_window_extent().width / ax.figure.dpi > 6.6
    ax.legend(
        loc="upper left", bbox_to_anchor=(0.0, 0.0), bbox_transform=below, ncols=4 if wide else 2, frameon=False,
        fontsize=9, handletextpad=0.2, columnspacing=1.2, borderaxespad=0.0, labelcolor=_INK,
    )  # fmt: skip
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    return ax


def _limit(places: PlotCoordinates, ax: Any) -> None:
    """Set limits that leave room for labels, whatever the cutoffs are."""
    x, y = places.x, places.y
    ax.set_xlim(0.0, 1.1 * max(float(x.max()), 1.4 * places.x_cutoff))
    beyond = 1.4 * places.y_cutoff
    low, high = min(float(y.min()), -beyond), max(float(y.max()), beyond)
    ax.set_ylim(low - 0.08 * (high - low), high + 0.08 * (high - low))


def _tint(places: PlotCoordinates, ax: Any) -> None:
    """Fill each region with a shade of the colour of its points, and draw the cutoffs as lines."""
    (left, right), (low, high) = ax.get_xlim(), ax.get_ylim()
    c, r = places.x_cutoff, places.y_cutoff
    for kind, across, up in (
        (1, (left, c), (r, high)),
        (1, (left, c), (low, -r)),
        (2, (c, right), (-r, r)),
        (3, (c, right), (r, high)),
        (3, (c, right), (low, -r)),
    ):
        ax.fill_between(across, *up, color=_STYLES[kind][1], alpha=0.07, linewidth=0, zorder=0)
    style = {"color": _LINE, "linewidth": 0.8, "linestyle": (0, (5, 3)), "zorder": 1}
    ax.axvline(c, **style)
    ax.axhline(-r, **style)
    ax.axhline(r, **style)


def _label(places: PlotCoordinates, ax: Any, labels: int) -> None:
    """Write the indices of the outermost samples where there is room; neighbouring samples share a label."""
    x, y = places.x, places.y
    far, large = x / places.x_cutoff, y.abs() / places.y_cutoff
    outer = (torch.maximum(far, large) > 1.0).nonzero().flatten()
    if outer.numel() == 0 or labels == 0:
        return
    # in points of the page
    page = ax.transData.transform(torch.stack([x, y], -1).numpy()) * 72.0 / ax.figure.dpi
    # relative to the largest in each direction, so that neither scale dominates
    rank = torch.maximum(far / far.max(), large / large.max())
    groups = linked_groups(page, outer[rank[outer].argsort(descending=True)].tolist())
    taken = [Box.around(place, 3.0) for place in page[outer.numpy()]]
    for group in groups[:labels]:
        text = ranges(group)
        place = free_place(page[group], text, _LETTERS, taken)
        if place is None:
            continue
        taken.append(place)
        middle = ax.transData.inverted().transform(torch.tensor(place.middle).numpy() * ax.figure.dpi / 72.0)
        ax.text(*middle, text, ha="center", va="center", color=_INK, fontsize=_LETTERS, zorder=4)
