"""Columns that a caller gives: checked, and out of a data frame."""

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

__all__ = ["EXPERIMENT", "FrameColumns", "checked_columns", "columns_of_frame", "table_of_frame"]

EXPERIMENT = "experiment"
"""The column that says which samples belong together; the one in which text is welcome."""


class FrameColumns(NamedTuple):
    """What a data frame holds of a recording."""

    columns: dict[str, Tensor]
    labels: dict[str, tuple[str, ...]]
    warnings: tuple[str, ...]


def checked_columns(columns: Mapping[str, Data], name: str) -> dict[str, Tensor]:
    """Columns as real tensors of one length >= 1.

    Args:
        columns: name to values, tensors or arrays.
        name: of the recording, for messages.

    Raises:
        RecordingError: they are none, or a name is unusable.
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


def columns_of_frame(frame: Any, names: Mapping[str, str], asked: Collection[str], name: str) -> FrameColumns:
    """The columns of a data frame that hold numbers, NaN where there is no value.

    Args:
        frame: of pandas or polars.
        names: for each name a column is to get, the name it has.
        asked: names beside those of ``names`` under which something else than numbers is an error.
        name: of the recording, for messages.

    Raises:
        RecordingError: no frame, columns of the same name or of none, or no numbers where they are needed.
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
        elif key in asked or key in names or _some_number(series):
            raise _refused(numbers, where)
        else:
            warnings.append(f"Column `{key}` holds no numbers and is left out.")
    if not columns:
        raise RecordingError(f"{where}no column of the frame holds numbers; it has {listed(taken)}.")
    return FrameColumns(columns, labels, tuple(warnings))


def table_of_frame(frame: Any, name: str) -> Table:
    """A data frame as a file's table: its columns as series of polars, to the last digit.

    Raises:
        RecordingError: no frame, one without rows, or columns without names.
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
            f"{where}expected a DataFrame but got {format_value(frame)}; columns are Recording({{...}})."
        )
    found = _with_index(frame)
    if nameless := [label for label, _ in found if not isinstance(label, str)]:
        raise RecordingError(f"{where}the columns of a frame need names of text but one is {nameless[0]!r}; rename it.")
    return Table([label.strip() for label, _ in found], [series for _, series in found], range(len(frame)), "row")


def _polars_series(series: Any) -> Any:
    package = polars()
    if isinstance(series, package.Series):
        return series
    kind = getattr(series.dtype, "kind", "O")
    if kind in "mM":  # with a zone too, in UTC then
        return package.Series(series.to_numpy(dtype=f"{'datetime' if kind == 'M' else 'timedelta'}64[ns]"))
    if kind in "iuf" and absent(series) is None:
        return package.Series(np.asarray(series.to_numpy()))
    numbers = _numbers("", series)
    if isinstance(numbers, Tensor):
        return package.Series(numbers.numpy())
    return package.Series(
        [None if one is None or one != one else str(one) for one in _cells(series)], dtype=package.String
    )


def _checked(key: object, values: object, where: str) -> Tensor:
    if not isinstance(key, str) or not key or key != key.strip() or any(end in key for end in "\r\n"):
        raise RecordingError(f"{where}{key!r} cannot name a column: one line of text, no spaces around it.")
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
    """The numbers of a column, NaN where one is missing, or why it has none."""
    try:
        return torch.from_numpy(numbers_of(f"column `{key}`", values, math.nan))
    except TypeError as error:
        return error


def _refused(error: TypeError, where: str) -> RecordingError:
    text = str(error)
    return RecordingError(f"{where}{text[0].lower()}{text[1:]}" if where else text)


def _with_index(frame: Any) -> list[tuple[Any, Any]]:
    """The columns of a frame, and its index where that has a name of its own."""
    columns = list(series_of(frame))
    index = getattr(frame, "index", None)
    label = getattr(index, "name", None)
    if isinstance(label, str) and label not in {name for name, _ in columns}:
        columns.insert(0, (label, index))
    return columns


def _numbered(series: Any) -> tuple[Tensor, tuple[str, ...]]:
    """Labels as 0, 1, … in the order of appearance, NaN where there is none, and the labels."""
    cells = [None if one is None or isinstance(one, float) else str(one).strip() for one in _cells(series)]
    numbers = {label: float(i) for i, label in enumerate(dict.fromkeys(cell for cell in cells if cell))}
    return torch.tensor([numbers.get(cell or "", math.nan) for cell in cells], dtype=torch.float64), tuple(numbers)


def _some_number(series: Any) -> bool:
    """Whether there are numbers among what is none."""
    return any(isinstance(one, (int, float, np.number)) and one == one for one in _cells(series))


def _cells(series: Any) -> list[Any]:
    """What stands in a column, None where nothing does."""
    cells = np.asarray(series.to_numpy()).tolist()
    gone = absent(series)
    return cells if gone is None else [None if none else one for one, none in zip(cells, gone, strict=True)]
