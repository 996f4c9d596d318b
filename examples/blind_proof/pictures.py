"""The pictures of the proof, as inline SVG with selectable text."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from examples.blind_proof.score import Bin, Score

# Okabe and Ito's colours, distinguishable with any colour vision
_BLUE, _ORANGE, _INK, _GREY, _PALE = "#0072B2", "#D55E00", "#222222", "#8A8A8A", "#D7DEE4"
_STYLE = {
    "font.family": "sans-serif",
    "font.size": 10.0,
    "axes.edgecolor": _GREY,
    "axes.labelcolor": _INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "xtick.color": _GREY,
    "ytick.color": _GREY,
    "xtick.labelcolor": _INK,
    "ytick.labelcolor": _INK,
    "legend.frameon": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "mkc",
    "savefig.transparent": True,
}


def power_curves(score: Score, baselines: Mapping[str, Score]) -> str:
    """Plot the shares found and named over z and z_sep, with their intervals."""
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(10.0, 3.8), layout="constrained")
        for ax, measure, title in zip(
            figure.subplots(1, 2, sharey=True), ("power_z", "power_z_sep"), ("z", "z_sep"), strict=True
        ):
            bins: Sequence[Bin] = getattr(score, measure)
            x = np.arange(len(bins))
            _curve(ax, x - 0.08, [b.found for b in bins], _GREY, "found")
            _curve(ax, x + 0.08, [b.named for b in bins], _BLUE, "named right")
            for name, other in baselines.items():
                _curve(ax, x, [b.named for b in getattr(other, measure)], _ORANGE, f"named right, {name}")
            ax.set_xticks(x, [f"{_edge(b)}\n({b.named.total})" for b in bins])
            ax.set_xlabel(f"{title} (number of recordings)")
            ax.set_ylim(-0.03, 1.03)
        figure.axes[0].set_ylabel("share of recordings")
        handles, labels = figure.axes[1].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper right", ncols=3, fontsize=9)
        return _svg(figure, "power", "Shares of the hidden effects that were found and named, over z and z_sep")


def p_values(score: Score) -> str:
    """Plot a histogram of the p-values of empty recordings."""
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(10.0, 3.0), layout="constrained")
        ax = figure.subplots()
        counts, edges = np.histogram(score.p_values, np.linspace(0.0, 1.0, 21))
        ax.stairs(counts, edges, fill=True, color=_PALE)
        ax.axhline(len(score.p_values) / 20.0, color=_BLUE, lw=1.2)
        ax.set_xlabel("p-value of an empty recording")
        ax.set_ylabel("recordings")
        ax.margins(x=0)
        return _svg(figure, "p-values", "Histogram of the p-values of empty recordings, with the uniform level")


def confusion(score: Score) -> str:
    """Plot the confusion matrix of hidden and named effects."""
    hidden = list(score.confusion)
    named = sorted({name for row in score.confusion.values() for name in row})
    if not hidden:
        return ""
    counts = np.array([[score.confusion[row].get(name, 0) for name in named] for row in hidden], dtype=float)
    shares = counts / counts.sum(1, keepdims=True)
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(10.0, 2.2 + 0.36 * len(hidden)), layout="constrained")
        ax = figure.subplots()
        ax.imshow(shares, cmap="Blues", vmin=0.0, vmax=1.3, aspect="auto")
        for i, row in enumerate(counts):
            for j, count in enumerate(row):
                if count:
                    ax.text(j, i, f"{count:.0f}", ha="center", va="center", color=_INK)
        ax.set_xticks(range(len(named)), named, rotation=35, ha="right")
        ax.set_yticks(range(len(hidden)), hidden)
        ax.set_xlabel("named first")
        ax.set_ylabel("hidden")
        return _svg(figure, "confusion", "Confusion matrix: hidden effects and the effects named first")


def _curve(ax: Any, x: np.ndarray, shares: Sequence[Any], color: str, label: str) -> None:
    value = np.array([s.value for s in shares])
    low, high = np.array([s.low for s in shares]), np.array([s.high for s in shares])
    known = np.isfinite(value)
    errors = np.stack([value - low, high - value])[:, known]
    ax.errorbar(x[known], value[known], errors, color=color, marker="o", ms=4, lw=1.4, elinewidth=0.8, label=label)


def _edge(b: Bin) -> str:
    if b.low == 0.0:
        return f"<{b.high:g}"
    return f">{b.low:g}" if math.isinf(b.high) else f"{b.low:g}-{b.high:g}"


def _svg(figure: Figure, name: str, description: str) -> str:
    """Return the figure as an SVG element. Its ids get a prefix, so that a page can hold several."""
    FigureCanvasSVG(figure)
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r'(?<= )id="', f'id="{name}-', text)
    text = text.replace("url(#", f"url(#{name}-").replace('href="#', f'href="#{name}-')
    text = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1)
    return text.replace("<svg", f'<svg role="img" aria-label="{description}"', 1)
