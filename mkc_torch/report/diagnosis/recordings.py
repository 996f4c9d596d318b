"""Name of a recording among several."""

from __future__ import annotations

from mkc_torch._support.typesetting import plain


def recording_called(number: int, name: str) -> str:
    """Return the number of a recording and, if it has one, its name.

    Example:
        >>> recording_called(2, "b.csv"), recording_called(2, "recording 2")
        ('recording 2 (b.csv)', 'recording 2')
    """
    known = f"recording {number}"
    return known if name in ("", known) else f"recording {number} ({plain(name)})"
