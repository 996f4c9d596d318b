"""Typeset texts from files, and numbers in them."""

from __future__ import annotations

import re
from collections.abc import Sequence

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_POWER_OF_TEN = re.compile(r"(?<![\w.])(\d+(?:\.\d+)?)e([+-]\d+)(?!\w)")
_MINUS = re.compile(r"(?<![\w.)\]-])-(?=\d)")


def plain(text: str) -> str:
    """Return a text from a file without line breaks and control characters.

    Example:
        >>> plain("coil \\x1b[31m\\n temperature")
        'coil �[31m temperature'
    """
    return "".join(c if c.isprintable() else "�" for c in " ".join(text.split()))


def several(names: Sequence[str], most: int = 6) -> str:
    """Join names; of many, only the first ``most``.

    Example:
        >>> several(["x", "y"]), several("abcdefgh", 3)
        ('x, y', 'a, b, c and 5 more')
    """
    text = ", ".join(plain(name) for name in names[:most])
    return f"{text} and {len(names) - most} more" if len(names) > most else text


def superscript(power: int) -> str:
    """Format an exponent.

    Example:
        >>> superscript(-6)
        '⁻⁶'
    """
    return str(power).translate(_RAISED)


def typeset(text: str) -> str:
    """Return a sentence without line breaks, with true minus signs and powers of ten.

    Example:
        >>> typeset("by -6.1° at (-0.2, +0.9); 8.82e-06 1/µT², log-2 of 2021-03-04")
        'by −6.1° at (−0.2, +0.9); 8.82 × 10⁻⁶ 1/µT², log-2 of 2021-03-04'
    """
    text = _POWER_OF_TEN.sub(lambda found: f"{found[1]} × 10{superscript(int(found[2]))}", plain(text))
    return _MINUS.sub("−", text)


def capital(text: str) -> str:
    """Capitalise the first letter."""
    return text[:1].upper() + text[1:]
