"""Columns that grow by a message at a time, for logs whose messages are decoded individually."""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence

import numpy as np

from mkc_torch._support.note import Note
from mkc_torch.recording.formats.base import Topic
from mkc_torch.recording.formats.topics import MOST_ELEMENTS, topic_of

Cell = float | int | str | tuple[float | int, ...]
"""A value of a message: a number, a text, or the numbers of an array."""

LARGEST_MESSAGE = 65536
"""Largest message in bytes; a larger message holds an image, a map or a scan, sensor messages have a few hundred."""

_MOST_COLUMNS = 4096
_WHOLE = range(-(2**63), 2**63)


class MessageRows:
    """The messages of a topic.

    Memory is eight bytes per number. A column is NaN in messages that lack it. Text, and arrays whose length changes or
    exceeds 64 elements, are left out.

    Args:
        name: name of the topic.
        units: units of its columns.
    """

    def __init__(self, name: str, units: Mapping[str, str]) -> None:
        self.name = name
        self._units = dict(units)
        self._columns: dict[str, array[int] | array[float]] = {}
        self._lengths: dict[str, int] = {}
        self._text: dict[str, None] = {}
        self._uneven: dict[str, None] = {}
        self._rows = 0

    def add(self, message: Mapping[str, Cell]) -> None:
        """Add a message."""
        for key, value in message.items():
            if isinstance(value, str):
                self._text[key] = None
            elif isinstance(value, tuple):
                if self._lengths.setdefault(key, len(value)) != len(value) or len(value) > MOST_ELEMENTS:
                    self._uneven[key] = None
                elif key not in self._uneven:
                    for place, element in enumerate(value):
                        self._put(f"{key}[{place}]", element)
            else:
                self._put(key, value)
        self._rows += 1

    def topic(self, first: Sequence[str], order_by: str, warnings: Sequence[str]) -> Topic | None:
        """The topic, with the columns ``first`` in front, sorted by ``order_by``; None if it has no numbers."""
        uneven = tuple(f"{key}[" for key in self._uneven)
        columns = {key: self._whole(values) for key, values in self._columns.items() if not key.startswith(uneven)}
        first = [key for key in first if key in columns]
        ordered = {key: columns[key] for key in [*first, *columns]}
        by = columns.get(order_by)
        if by is not None and (np.diff(by) < 0).any():
            places = np.argsort(by, kind="stable")
            ordered = {key: values[places] for key, values in ordered.items()}
        messages = list(warnings)
        if self._uneven:
            names = ", ".join(f"`{key}`" for key in list(self._uneven)[:8])
            what = "an array of changing length or of" if len(self._uneven) == 1 else "arrays of changing length or of"
            messages.append(Note(f"{names}: {what} more than {MOST_ELEMENTS} elements, left out."))
        text = [key for key in self._text if key not in self._columns]
        if text:
            verb = "holds text and is" if len(text) == 1 else "hold text and are"
            messages.append(Note(f"{', '.join(f'`{key}`' for key in text[:8])} {verb} left out."))
        return topic_of(self.name, ordered, self._units, messages, line="message")

    def _put(self, key: str, value: float | int) -> None:
        column = self._columns.get(key)
        if column is None:
            if len(self._columns) >= _MOST_COLUMNS:
                self._uneven[key] = None
                return
            whole = isinstance(value, int) and not self._rows
            column = self._columns[key] = array("q") if whole else array("d")
        if len(column) > self._rows:  # a repeated name in a message
            return
        if column.typecode == "q" and (not isinstance(value, int) or value not in _WHOLE or len(column) < self._rows):
            column = self._columns[key] = array("d", map(_real, column))
        if len(column) < self._rows:
            column.extend(array("d", [np.nan]) * (self._rows - len(column)))  # type: ignore[arg-type]
        column.append(_real(value) if column.typecode == "d" else value)  # type: ignore[arg-type]

    def _whole(self, values: array[int] | array[float]) -> np.ndarray:
        found = np.frombuffer(values, np.int64 if values.typecode == "q" else np.float64)
        if len(found) == self._rows:
            return found
        return np.concatenate([found.astype(np.float64), np.full(self._rows - len(found), np.nan)])


def _real(value: float) -> float:
    """Convert to float64; infinite for a whole number beyond its range, as JSON can hold."""
    try:
        return float(value)
    except OverflowError:
        return float("inf") if value > 0 else float("-inf")
