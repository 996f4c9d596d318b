"""Name of a recording among several."""

from __future__ import annotations

from mkc_torch._words.terms import term
from mkc_torch._words.typesetting import plain

__all__ = ["recording_called"]


def recording_called(number: int, name: str) -> str:
    """Return the number of a recording and, if it has one, its name.

    Example:
        >>> recording_called(2, "b.csv"), recording_called(2, "recording 2")
        ('recording 2 (b.csv)', 'recording 2')
    """
    known = term("where.recording", number=number)
    return known if name in ("", known) else term("where.recording_of_name", number=number, name=plain(name))
