"""Parquet."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mkc_torch.recording.formats.base import FileFormat, RecordingError, Table, Topic, polars

__all__ = ["PARQUET"]


def read(path: Path) -> Table:
    """The table in a Parquet file."""
    package = polars()
    try:
        frame = package.read_parquet(io.BytesIO(path.read_bytes()))  # a path would be a pattern
    except package.exceptions.PolarsError as error:
        raise RecordingError(
            f"{path}: this is no Parquet file, or a damaged one: {str(error).splitlines()[0]}"
        ) from error
    if not len(frame):
        raise RecordingError(f"{path}: the table has no rows.")
    return Table([name.strip() for name in frame.columns], frame.get_columns(), range(1, len(frame) + 1), "row")


def encoded(_path: Path, columns: Mapping[str, np.ndarray]) -> bytes:
    """The content of a file with these columns."""
    buffer = io.BytesIO()
    polars().DataFrame(dict(columns)).write_parquet(buffer)
    return buffer.getvalue()


PARQUET = FileFormat((".parquet",), lambda path: [Topic("", read(path))], encoded)
