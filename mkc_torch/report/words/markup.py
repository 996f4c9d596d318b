"""Texts on a page: what is code, and where lines may not end."""

from __future__ import annotations

import re

from markupsafe import Markup, escape

__all__ = ["marked", "unbroken"]


def marked(text: str) -> Markup:
    """A text for a page, with what stands between backticks as code.

    Example:
        >>> marked("Column `a<b` is constant.")
        Markup('Column <code>a&lt;b</code> is constant.')
    """
    return Markup(re.sub("`([^`]+)`", r"<code>\1</code>", str(escape(text))))


def unbroken(page: str) -> str:
    """A page whose lines end neither before a per cent sign nor about a plus-minus.

    Example:
        >>> unbroken("95 % of 1.0 ± 0.1").count("\\u00a0")
        3
    """
    return re.sub("(?<=[0-9]) %", "\u00a0%", page).replace(" ± ", "\u00a0±\u00a0")
