"""HTML tables for notebooks, with escaped text, in the colours of the page for light and dark themes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

_CELL = "padding:2px 10px 2px 0;border-bottom:1px solid color-mix(in srgb,currentColor 25%,transparent)"


def html_table(caption: str, columns: Sequence[str], rows: Sequence[Sequence[str]], below: Sequence[str] = ()) -> str:
    """A table with a caption above it and sentences below; the first cell of a row is its heading.

    Example:
        >>> page = html_table("a < b", ["", "µT"], [["x", "1"]], ["done"])
        >>> "a &lt; b" in page, page.count("<td")
        (True, 1)
    """
    head = "".join(
        f'<th style="{_CELL};text-align:{"left" if i == 0 else "right"};font-weight:500">{escape(c)}</th>'
        for i, c in enumerate(columns)
    )
    body = "".join(
        f'<tr style="background:none"><th style="{_CELL};text-align:left;font-weight:500">{escape(name)}</th>'
        + "".join(f'<td style="{_CELL};text-align:right">{escape(cell)}</td>' for cell in cells)
        + "</tr>"
        for name, *cells in rows
    )
    table = (
        '<div style="overflow-x:auto"><table style="border-collapse:collapse;font-variant-numeric:tabular-nums">'
        f"{f'<thead><tr>{head}</tr></thead>' if any(columns) else ''}<tbody>{body}</tbody></table></div>"
    )
    sentences = "".join(f'<p style="margin:4px 0 0;max-width:76ch">{escape(sentence)}</p>' for sentence in below)
    return (
        f'<div><p style="margin:0 0 4px"><strong>{escape(caption)}</strong></p>{table if rows else ""}{sentences}</div>'
    )


def with_error(value: float, error: float) -> str:
    """A number with its standard error, both rounded to two digits of the error.

    Example:
        >>> with_error(11.96931, 0.01712), with_error(-0.5, math.inf), with_error(5123.0, 210.0)
        ('11.969 ± 0.017', '−0.5', '5123 ± 210')
    """
    if not 0.0 < error < math.inf:
        return f"{value:.4g}".replace("-", "−")
    decimals = min(max(1 - math.floor(math.log10(error)), 0), 9)
    return f"{value:.{decimals}f} ± {error:.{decimals}f}".replace("-", "−")
