"""A table's own columns beside new ones: text, times and numbers as they stand in the file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mkc_torch._support.files import write_atomically
from mkc_torch.recording.formats import check_ending, encoded, read_topics
from mkc_torch.recording.formats.cells import as_numbers
from mkc_torch.recording.formats.csv import CSV

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["write_beside"]


def write_beside(
    source: Path, path: Path, columns: Mapping[str, Tensor], *, topic: int = 0, overwrite: bool = False
) -> tuple[str, ...]:
    """Write the columns of a file, in its order, with others: in the place of one of that name, or after all.

    What is text in the file is written as it is, to the last digit; into a Parquet file numbers go as numbers.

    Args:
        source: the file that was read.
        path: the target; its ending says the format.
        columns: name to values, (N,) for the N rows of the file.
        topic: number of the topic, where the file holds several.
        overwrite: replace an existing file.

    Returns:
        The names of what was written.

    Raises:
        RecordingError: the source is no table, or an ending that is not known.
        FileExistsError: the target exists and ``overwrite`` is False.
    """
    check_ending(path)
    table = read_topics(source)[topic].table
    as_text = path.suffix.lower() in CSV.endings
    told = {name: _cells(series, as_text) for name, series in zip(table.names, table.series, strict=True) if name}
    told |= {name: values.numpy() for name, values in columns.items()}
    write_atomically(path, encoded(path, told), overwrite=overwrite)
    return tuple(told)


def _cells(series: Any, as_text: bool) -> np.ndarray:
    """Values for an encoder: numbers, or the text of each."""
    if series.dtype.is_numeric():
        return series.to_numpy()
    numbers, bad = as_numbers(series)
    if not as_text and not bad.any():
        return numbers.fill_null(float("nan")).to_numpy()
    if not as_text and not _is_text(series):
        return series.to_numpy()
    return np.array(["" if value is None else str(value) for value in series.to_list()], dtype=object)


def _is_text(series: Any) -> bool:
    return all(value is None or isinstance(value, str) for value in series.head(100).to_list())
