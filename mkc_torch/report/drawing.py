"""Convert figures to SVG elements."""

from __future__ import annotations

import io
import re

from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from mkc_torch._support.drawing import BLUE, DARK_ORANGE, INK, ORANGE

_OF_PAGE = {
    INK.lower(): "ink",
    DARK_ORANGE.lower(): "orange",
    BLUE.lower(): "first",
    ORANGE.lower(): "second",
    "#ffffff": "paper",
}
"""Colours that follow the page's light or dark theme, by the names of its CSS variables."""


def svg(figure: Figure, name: str, description: str) -> str:
    """Return the figure as an SVG element; ids get the prefix ``name``, so that a page can contain several."""
    FigureCanvasSVG(figure)
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", dpi=150, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r'(?<= )id="', f'id="{name}-', text)
    text = text.replace("url(#", f"url(#{name}-").replace('href="#', f'href="#{name}-')
    text = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1)
    text = re.sub(rf"(?<=: )({'|'.join(_OF_PAGE)})\b", lambda found: themed(found[1]), text)
    return text.replace("<svg", f'<svg role="img" aria-label="{description}"', 1)


def themed(color: str) -> str:
    """Return a hexadecimal colour as CSS that follows the page's theme; other colours are the same in both.

    Example:
        >>> themed("#0072B2"), themed("#009E73")
        ('var(--first, #0072b2)', '#009e73')
    """
    name = _OF_PAGE.get(color.lower())
    return color.lower() if name is None else f"var(--{name}, {color.lower()})"
