"""Notes and warnings: a warning questions a result, a note states how the data were read."""

from __future__ import annotations

from collections.abc import Iterable


class Note(str):
    """A sentence on how data were read, such as a column's name or a converted unit.

    It does not question a result. A sentence of plain ``str`` among notes is a warning.

    Example:
        >>> sentences = (Note("Decimal commas were read as points."), "The time ran backwards once.")
        >>> notes_of(sentences), warnings_of(sentences)
        (('Decimal commas were read as points.',), ('The time ran backwards once.',))
    """

    __slots__ = ()


def notes_of(sentences: Iterable[str]) -> tuple[Note, ...]:
    """Return the notes among sentences, without repetition."""
    return tuple(dict.fromkeys(sentence for sentence in sentences if isinstance(sentence, Note)))


def warnings_of(sentences: Iterable[str]) -> tuple[str, ...]:
    """Return the warnings among sentences."""
    return tuple(sentence for sentence in sentences if not isinstance(sentence, Note))
