"""Write a file's own columns together with new columns, with text, times and numbers as in the file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mkc_torch._support.files import write_atomically
from mkc_torch.recording.formats import check_ending, encoded, read_topics
from mkc_torch.recording.formats.base import Topic, polars
from mkc_torch.recording.formats.cells import as_numbers
from mkc_torch.recording.formats.csv import CSV, encoded_series
from mkc_torch.recording.row_sensors import with_row_sensors

if TYPE_CHECKING:
    from torch import Tensor

_LEADING_ZERO = r"^\s*[+-]?0\d"
"""Pattern of digits that are a name rather than a number, such as 007."""


def write_with_columns(
    source: Path,
    path: Path,
    columns: Mapping[str, Tensor],
    *,
    topic: int = 0,
    overwrite: bool = False,
    topics: Sequence[Topic] | None = None,
) -> tuple[str, ...]:
    """Write the columns of a file in their order, with further columns replaced by name or appended.

    Text of the file is written unchanged, to the last digit. A Parquet target receives numbers as numbers, and columns
    of a Parquet source keep their types; a text target receives times as ISO 8601. Columns without a name stay so.

    Args:
        source: the file that was read.
        path: the target; its ending selects the format.
        columns: name to values, (N,) for the N rows of the file.
        topic: index of the topic if the file holds several.
        overwrite: replace an existing file.
        topics: the file's tables if they have been read already.

    Returns:
        The names of the written columns.

    Raises:
        RecordingError: the source is not a table, or the ending is unknown.
        FileExistsError: the target exists and ``overwrite`` is False.
    """
    check_ending(path)
    topics = read_topics(source) if topics is None else topics
    if any(len(values) != len(topics[min(topic, len(topics) - 1)].table.lines) for values in columns.values()):
        topics = with_row_sensors(topics)  # the rows of a single sensor
    table = topics[topic].table
    of_text, as_text = (file.suffix.lower() in CSV.endings for file in (source, path))
    written: dict[str, Any] = {}
    copied = table.with_units if as_text and table.with_units is not None else table.series
    for name, series in zip(table.names, copied, strict=True):
        while not name and name in written:
            name += " "  # blanks make empty names unique and are stripped on reading
        written[name] = _texts(series) if as_text else _typed(series) if of_text else series
    if as_text:
        written |= {name: _number_texts(values.numpy()) for name, values in columns.items()}
        content: str | bytes = encoded_series(path, written)
    else:
        written |= {name: values.numpy() for name, values in columns.items()}
        content = encoded(path, written)
    write_atomically(path, content, overwrite=overwrite)
    return tuple(written)


def _typed(series: Any) -> Any:
    """Convert a text column that holds only numbers to numbers, for a file with types."""
    package = polars()
    numbers, bad = as_numbers(series)
    if bad.any() or series.str.contains(_LEADING_ZERO).any() or numbers.is_null().all():
        return series
    whole = series.str.strip_chars().cast(package.Int64, strict=False)
    # beyond 2^53 a float loses digits of a whole number, such as a time stamp in ns
    return whole if whole.null_count() == numbers.null_count() else numbers


def _texts(series: Any) -> Any:
    """The text of each cell, null for missing values and empty text."""
    package = polars()
    if series.dtype == package.Float64:
        return _number_texts(series.to_numpy()).zip_with(series.is_not_null(), package.Series([None]))
    if series.dtype.is_temporal():
        cells = series.dt.to_string("iso")
    elif series.dtype.is_nested() or series.dtype in (package.Binary, package.Object):
        texts = [None if value is None else str(_plain(value)) for value in series.to_list()]
        cells = package.Series(texts, dtype=package.String)
    else:
        cells = series.cast(package.String)
    return cells.zip_with(cells != "", package.Series([None], dtype=package.String))


def _number_texts(values: np.ndarray) -> Any:
    """Numbers for the writer, which writes the shortest text that is read back as the same number."""
    package = polars()
    if values.dtype.kind != "f" or bool(np.isfinite(values).all()):
        return package.Series(values)
    return package.Series([repr(value) for value in values.tolist()], dtype=package.String)


def _plain(value: Any) -> Any:
    return value.to_list() if hasattr(value, "to_list") else value
