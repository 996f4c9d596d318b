"""Texts from files and numbers within them, as a reader sees them in print."""

from __future__ import annotations

import re
from collections.abc import Sequence

from mkc_torch._words.terms import term

__all__ = ["capital", "plain", "several", "superscript", "typeset"]

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_POWER_OF_TEN = re.compile(r"(?<![\w.])(\d+(?:\.\d+)?)e([+-]\d+)(?!\w)")
_MINUS = re.compile(r"(?<![\w.)\]-])-(?=\d)")


def plain(text: str) -> str:
    """A text from a file on one line, without characters that steer a terminal.

    Example:
        >>> plain("coil \\x1b[31m\\n temperature")
        'coil �[31m temperature'
    """
    return "".join(c if c.isprintable() else "�" for c in " ".join(text.split()))


def several(names: Sequence[str], most: int = 6) -> str:
    """Names one after the other; of many, the first ones.

    Example:
        >>> several(["x", "y"]), several("abcdefgh", 3)
        ('x, y', 'a, b, c and 5 more')
    """
    told = ", ".join(plain(name) for name in names[:most])
    return term("number.and_more", first=told, count=len(names) - most) if len(names) > most else told


def superscript(power: int) -> str:
    """A power.

    Example:
        >>> superscript(-6)
        '⁻⁶'
    """
    return str(power).translate(_RAISED)


def typeset(text: str) -> str:
    """A sentence on one line, its numbers with a true minus sign and powers of ten.

    Example:
        >>> typeset("by -6.1° at (-0.2, +0.9); 8.82e-06 1/µT², log-2 of 2021-03-04")
        'by −6.1° at (−0.2, +0.9); 8.82 × 10⁻⁶ 1/µT², log-2 of 2021-03-04'
    """
    text = _POWER_OF_TEN.sub(lambda found: f"{found[1]} × 10{superscript(int(found[2]))}", plain(text))
    return _MINUS.sub("−", text)


def capital(text: str) -> str:
    """With a capital letter at its beginning."""
    return text[:1].upper() + text[1:]
