"""Rows of warnings and notes: warnings first, by importance; then notes in few lines, with a count of the rest."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence

from mkc_torch._support.typesetting import plain

NOTE = "note"
"""Label of a note."""

MOST_LINES = 5
"""Most warnings, and most lines of notes."""


def warning_rows(warnings: Sequence[str], file: str, most: int = MOST_LINES) -> Iterator[tuple[str, str]]:
    """Yield a label and a text for each warning; the first is always shown.

    Args:
        warnings: most important first.
        file: the file that lists all of them.
        most: most rows.

    Example:
        >>> [text for _, text in warning_rows(["a", "b", "c"], "report.html", most=2)]
        ['a', '2 more; see report.html']
    """
    shown = warnings if len(warnings) <= most else warnings[: max(most - 1, 1)]
    for warning in shown:
        yield "warning", warning
    if len(shown) < len(warnings):
        yield "warning", f"{len(warnings) - len(shown)} more; see {file}"


def note_rows(notes: Sequence[str], file: str, width: int) -> Iterator[tuple[str, str]]:
    """Yield a label and a text for each note that fits into five lines, and the number of the others.

    Args:
        notes: in any order.
        file: the file that lists all of them.
        width: letters of a line.

    Example:
        >>> [text for _, text in note_rows(["a", "b " * 90, "c"], "report.html", 50)]
        ['a', 'c', '1 more; see report.html']
    """
    lines = [len(textwrap.wrap(plain(note), max(width, 20))) for note in notes]
    room = MOST_LINES if sum(lines) <= MOST_LINES else MOST_LINES - 1
    shown = []
    for note, count in zip(notes, lines, strict=True):
        if count <= room:
            shown.append(note)
            room -= count
    for note in shown:
        yield NOTE, note
    if len(shown) < len(notes):
        yield NOTE, f"{len(notes) - len(shown)} more; see {file}"
