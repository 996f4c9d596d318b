"""Check the columns that a caller gives, and take them from a data frame."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.arguments import format_value
from mkc_torch._support.arrays import Data, absent, is_array, is_frame, numbers_of, series_of
from mkc_torch.recording.formats.base import RecordingError, Table, listed, polars
from mkc_torch.recording.formats.cells import renamed

EXPERIMENT = "experiment"
"""Name of the column that numbers the runs; the only column in which text is accepted."""


class FrameColumns(NamedTuple):
    """Columns, labels and warnings of a data frame."""

    columns: dict[str, Tensor]
    labels: dict[str, tuple[str, ...]]
    warnings: tuple[str, ...]


def checked_columns(columns: Mapping[str, Data], name: str) -> dict[str, Tensor]:
    """Convert columns to real tensors of equal length >= 1.

    Args:
        columns: name to values, tensors or arrays.
        name: name of the recording, for messages.

    Raises:
        RecordingError: no columns, no samples, unequal lengths, values that are not real numbers, or a bad name.
    """
    where = f"{name}: " if name else ""
    if not columns:
        raise RecordingError(f"{where}a recording needs at least one column.")
    given = {key: _checked(key, values, where) for key, values in columns.items()}
    lengths = {key: len(values) for key, values in given.items()}
    if len(set(lengths.values())) > 1:
        each = ", ".join(f"`{key}` {length}" for key, length in lengths.items())
        raise RecordingError(f"{where}the columns differ in length: {each}.")
    if not all(lengths.values()):
        raise RecordingError(f"{where}the columns hold no samples.")
    return given


def columns_of_frame(frame: Any, names: Mapping[str, str], required: Collection[str], name: str) -> FrameColumns:
    """The numeric columns of a data frame, with NaN for missing values.

    Args:
        frame: a frame of pandas or polars.
        names: new name to the name in the frame.
        required: further required columns; a required column without numbers is an error.
        name: name of the recording, for messages.

    Raises:
        RecordingError: not a frame, duplicate or missing column names, or no numbers where they are needed.
        MissingColumnError: ``names`` has a column that the frame does not have.
    """
    where = f"{name}: " if name else ""
    table = _table(frame, where)
    taken, warnings = renamed(table, names, name or "The frame", "frame")
    columns: dict[str, Tensor] = {}
    labels: dict[str, tuple[str, ...]] = {}
    for key, series in taken.items():
        numbers = _numbers(key, series)
        if isinstance(numbers, Tensor):
            columns[key] = numbers
        elif key == EXPERIMENT:
            columns[key], labels[key] = _numbered(series)
        elif key in required or key in names or _some_number(series):
            raise _refused(numbers, where)
        else:
            warnings.append(f"Column `{key}` holds no numbers and is left out.")
    if not columns:
        raise RecordingError(f"{where}no column of the frame holds numbers; it has {listed(taken)}.")
    return FrameColumns(columns, labels, tuple(warnings))


def table_of_frame(frame: Any, name: str) -> Table:
    """Convert a data frame to a table of polars series, without loss of digits.

    Raises:
        RecordingError: not a frame, a frame without rows, or columns without names.
        ImportError: polars is not installed.
    """
    where = f"{name}: " if name else ""
    table = _table(frame, where)
    if not len(table.lines):
        raise RecordingError(f"{where}the columns hold no samples.")
    return table._replace(series=[_polars_series(series) for series in table.series])


def _table(frame: Any, where: str) -> Table:
    if not is_frame(frame):
        raise RecordingError(
            f"{where}expected a DataFrame but got {format_value(frame)}; make a recording of columns by "
            "Recording({...})."
        )
    found = _with_index(frame)
    if nameless := [label for label, _ in found if not isinstance(label, str)]:
        raise RecordingError(
            f"{where}the column names of a frame must be text but got {nameless[0]!r}; rename that column."
        )
    return Table([label.strip() for label, _ in found], [series for _, series in found], range(len(frame)), "row")


def _polars_series(series: Any) -> Any:
    package = polars()
    if isinstance(series, package.Series):
        return series
    kind = getattr(series.dtype, "kind", "O")
    if kind in "mM":  # with a time zone: in UTC
        return package.Series(series.to_numpy(dtype=f"{'datetime' if kind == 'M' else 'timedelta'}64[ns]"))
    if kind in "iuf" and absent(series) is None:
        return package.Series(np.asarray(series.to_numpy()))
    numbers = _numbers("", series)
    if isinstance(numbers, Tensor):
        return package.Series(numbers.numpy())
    return package.Series(
        [None if cell is None or cell != cell else str(cell) for cell in _cells(series)], dtype=package.String
    )


def _checked(key: object, values: object, where: str) -> Tensor:
    if not isinstance(key, str) or not key or key != key.strip() or any(end in key for end in "\r\n"):
        raise RecordingError(
            f"{where}{key!r} cannot name a column; use a single line of text without spaces around it."
        )
    if is_array(values) and not is_frame(values):
        values = _numbers(key, values)
        if isinstance(values, TypeError):
            raise _refused(values, where)
    if not isinstance(values, Tensor) or values.is_complex():
        got = f"a tensor of {values.dtype}" if isinstance(values, Tensor) else type(values).__name__
        raise RecordingError(f"{where}expected column `{key}` to be a real tensor but got {got}.")
    if values.dim() != 1:
        raise RecordingError(f"{where}expected column `{key}` to have shape (N,) but got {tuple(values.shape)}.")
    return values


def _numbers(key: str, values: object) -> Tensor | TypeError:
    """The numbers of a column, with NaN for missing values, or the error if it is not numeric."""
    try:
        return torch.from_numpy(numbers_of(f"column `{key}`", values, math.nan))
    except TypeError as error:
        return error


def _refused(error: TypeError, where: str) -> RecordingError:
    text = str(error)
    return RecordingError(f"{where}{text[0].lower()}{text[1:]}" if where else text)


def _with_index(frame: Any) -> list[tuple[Any, Any]]:
    """The columns of a frame, and its index if it has a name of its own."""
    columns = list(series_of(frame))
    index = getattr(frame, "index", None)
    label = getattr(index, "name", None)
    if isinstance(label, str) and label not in {name for name, _ in columns}:
        columns.insert(0, (label, index))
    return columns


def _numbered(series: Any) -> tuple[Tensor, tuple[str, ...]]:
    """Number labels 0, 1, … in the order of appearance, with NaN for missing labels; returns numbers and labels."""
    cells = [None if cell is None or isinstance(cell, float) else str(cell).strip() for cell in _cells(series)]
    numbers = {label: float(i) for i, label in enumerate(dict.fromkeys(cell for cell in cells if cell))}
    return torch.tensor([numbers.get(cell or "", math.nan) for cell in cells], dtype=torch.float64), tuple(numbers)


def _some_number(series: Any) -> bool:
    """Whether some cell of a column is a number."""
    return any(isinstance(cell, (int, float, np.number)) and cell == cell for cell in _cells(series))


def _cells(series: Any) -> list[Any]:
    """The cells of a column, with None for missing values."""
    cells = np.asarray(series.to_numpy()).tolist()
    gone = absent(series)
    return cells if gone is None else [None if missing else cell for cell, missing in zip(cells, gone, strict=True)]
