"""Markup of texts: code, and non-breaking spaces."""

from __future__ import annotations

import re

from markupsafe import Markup, escape


def marked(text: str) -> Markup:
    """Escape a text and set the text between backticks as code.

    Example:
        >>> marked("Column `a<b` is constant.")
        Markup('Column <code>a&lt;b</code> is constant.')
    """
    return Markup(re.sub("`([^`]+)`", r"<code>\1</code>", str(escape(text))))


def unbroken(page: str) -> str:
    """Insert non-breaking spaces before per cent signs and around plus-minus signs.

    Example:
        >>> unbroken("95 % of 1.0 ± 0.1").count("\\u00a0")
        3
    """
    return re.sub("(?<=[0-9]) %", "\u00a0%", page).replace(" ± ", "\u00a0±\u00a0")
