"""Make a topic of NumPy arrays: numbers become columns; other arrays are left out with a warning."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mkc_torch._support.note import Note
from mkc_torch.recording.formats.base import Table, Topic, listed, polars

MOST_ELEMENTS = 64
"""Most elements of an array per row; larger arrays are images, spectra or maps, not sets of channels."""

_STAMP = re.compile(r"\s*\d{4}-\d\d-\d\d([T ]\d\d:\d\d|\s*$)")
_LABELS = "experiment"


def spread(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Split an array (N, …) into columns: ``name_x``, ``name_y``, ``name_z`` for (N, 3), else ``name[0]``, ….

    Example:
        >>> list(spread("mag", np.zeros((5, 3)))), list(spread("q", np.zeros((5, 2)))), list(spread("t", np.zeros(5)))
        (['mag_x', 'mag_y', 'mag_z'], ['q[0]', 'q[1]'], ['t'])
    """
    if values.ndim == 1:
        return {name: values}
    if values.ndim == 2 and values.shape[1] == 1:
        return {name: values[:, 0]}
    if values.ndim == 2 and values.shape[1] == 3:
        return {f"{name}_{axis}": values[:, place] for place, axis in enumerate("xyz")}
    return {
        name + "".join(f"[{place}]" for place in index): values[(slice(None), *index)]
        for index in np.ndindex(values.shape[1:])
    }


def topic_of(
    name: str,
    columns: Mapping[str, np.ndarray],
    units: Mapping[str, str] | None = None,
    warnings: Sequence[str] = (),
    line: str = "row",
) -> Topic | None:
    """Make a topic of columns of equal length; None if no column holds numbers.

    Text is left out unless it begins like an ISO 8601 time stamp or is the column ``experiment``.

    Args:
        name: name of the topic.
        columns: name to values (N,), of any type.
        units: column to unit; columns that are left out are ignored.
        warnings: warnings to keep.
        line: the word for a row in messages.
    """
    package = polars()
    kept: dict[str, Any] = {}
    text, other, more_units = [], [], {}
    for key, values in columns.items():
        if values.dtype.kind in "Mm":
            count = values.astype(f"{values.dtype.kind}8[ns]").astype(np.int64)
            kept[key] = package.Series(key, count)
            more_units[key] = "ns"
        elif values.dtype.kind in "biuf":
            kept[key] = package.Series(key, _native(values))
        elif values.dtype.kind in "SUO" and (cells := _texts(values)) is not None:
            first = next((cell for cell in cells if cell), "")
            if _STAMP.match(first) or (key == _LABELS and first):
                kept[key] = package.Series(key, cells, dtype=package.String)
            else:
                text.append(key)
        else:
            other.append(key)
    found = list(warnings)
    for names, what in ((text, "text"), (other, "no plain numbers")):
        if names:
            verb = "holds" if len(names) == 1 else "hold"
            found.append(Note(f"{_columns(names)} {verb} {what} and {_left(names)}."))
    if not any(series.dtype != package.String for series in kept.values()):
        return None
    rows = len(next(iter(kept.values())))
    table = Table(list(kept), list(kept.values()), range(1, rows + 1), line)
    known = {key: unit for key, unit in {**more_units, **(units or {})}.items() if key in kept and unit}
    return Topic(name, table, known, tuple(found))


def _native(values: np.ndarray) -> np.ndarray:
    """Convert an array to contiguous memory, native byte order, and 32 or 64 bits for floats."""
    if values.dtype.kind == "f" and values.dtype.itemsize not in (4, 8):
        return values.astype(np.float32 if values.dtype.itemsize < 4 else np.float64)
    return np.ascontiguousarray(values, values.dtype.newbyteorder("="))


def _texts(values: np.ndarray) -> list[str] | None:
    """The cells as text; None if a cell is not text."""
    cells = values.tolist()
    if not all(cell is None or isinstance(cell, str | bytes) for cell in cells):
        return None
    return [cell.decode("utf-8", "replace") if isinstance(cell, bytes) else cell or "" for cell in cells]


def _columns(names: Sequence[str]) -> str:
    shown = listed(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
    return f"{'Column' if len(names) == 1 else 'Columns'} {shown}"


def _left(names: Sequence[str]) -> str:
    return "is left out" if len(names) == 1 else "are left out"
