"""File formats of recordings, one a file; a new one is a :class:`FileFormat` in ``FORMATS``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mkc_torch.recording.formats.base import FileFormat, MissingColumnError, RecordingError, Table
from mkc_torch.recording.formats.csv import CSV
from mkc_torch.recording.formats.parquet import PARQUET

__all__ = ["FORMATS", "MissingColumnError", "RecordingError", "check_ending", "encoded", "read_table"]

FORMATS: tuple[FileFormat, ...] = (CSV, PARQUET)
"""All formats; the ending of a file says which it is of."""


def read_table(path: Path) -> Table:
    """The table in a file; at least one of its columns has a name.

    Raises:
        RecordingError: no file of a known kind, or a damaged or empty one.
        FileNotFoundError: no such file.
    """
    _check_file(path)
    table = _format_of(path).read(path)
    if not any(table.names):
        raise RecordingError(f"{path}: no column has a name; the first line must hold the column names.")
    return table


def encoded(path: Path, columns: Mapping[str, np.ndarray]) -> str | bytes:
    """The content of a table file of the kind that the ending of ``path`` says."""
    return _format_of(path).encoded(path, columns)


def check_ending(path: Path) -> None:
    """Refuse a file whose ending says no known kind of table."""
    _format_of(path)


def _format_of(path: Path) -> FileFormat:
    by_ending = {ending: file_format for file_format in FORMATS for ending in file_format.endings}
    if path.suffix.lower() not in by_ending:
        kind = f"files ending in {path.suffix}" if path.suffix else "files without an ending"
        raise RecordingError(f"{path}: {kind} are not known; known are {', '.join(by_ending)}.")
    return by_ending[path.suffix.lower()]


def _check_file(path: Path) -> None:
    if path.is_dir():
        raise RecordingError(f"{path}: this is a folder; name the file in it.")
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file.")
    if path.is_file() and path.stat().st_size == 0:
        raise RecordingError(f"{path}: the file is empty; it must hold a header line and rows of numbers.")
