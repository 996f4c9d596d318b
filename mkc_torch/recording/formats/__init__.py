"""File formats of recordings, a module each; add a :class:`FileFormat` to ``FORMATS`` for a new format."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mkc_torch.recording.formats.base import FileFormat, MissingColumnError, RecordingError, Topic
from mkc_torch.recording.formats.csv import CSV
from mkc_torch.recording.formats.dataflash import DATAFLASH
from mkc_torch.recording.formats.hdf5 import HDF5
from mkc_torch.recording.formats.mat import MAT
from mkc_torch.recording.formats.mcap import MCAP
from mkc_torch.recording.formats.mdf import MDF
from mkc_torch.recording.formats.parquet import PARQUET
from mkc_torch.recording.formats.rosbag1 import ROSBAG1
from mkc_torch.recording.formats.rosbag2 import ROSBAG2
from mkc_torch.recording.formats.ulog import ULOG

__all__ = ["FORMATS", "MissingColumnError", "RecordingError", "Topic", "check_ending", "encoded", "read_topics"]

FORMATS: tuple[FileFormat, ...] = (CSV, PARQUET, ULOG, DATAFLASH, MCAP, ROSBAG1, ROSBAG2, MAT, HDF5, MDF)
"""All formats; the ending of a file selects the format."""

_ADVICE = (
    ((".gz", ".zip", ".7z", ".bz2", ".xz", ".zst", ".tar", ".tgz", ".rar"), "unpack it first"),
    ((".xlsx", ".xls", ".ods", ".numbers"), "export the sheet as CSV"),
    ((".json", ".jsonl", ".xml", ".html", ".yaml"), "export it as CSV"),
)
_RENAME = "if it is text with separators, rename it to end in .csv"

_WRITTEN = "a .csv or a .parquet"


def read_topics(path: Path) -> list[Topic]:
    """Read the tables of a file: at least one, each with at least one named column.

    Raises:
        RecordingError: the file is of an unknown kind, damaged or empty.
        FileNotFoundError: there is no such file.
    """
    check_file(path)
    topics = [topic for topic in _format_of(path).topics(path) if any(topic.table.names)]
    if not topics:
        raise RecordingError(f"{path}: no column has a name; the first line must hold the column names.")
    return topics


def encoded(path: Path, columns: Mapping[str, np.ndarray]) -> str | bytes:
    """Encode columns as a table file in the format that the ending of ``path`` selects."""
    encoder = _format_of(path).encoded
    if encoder is None:
        raise RecordingError(f"{path}: files ending in {path.suffix} can be read but not written; write {_WRITTEN}.")
    return encoder(path, columns)


def check_ending(path: Path) -> None:
    """Raise a RecordingError if the ending does not select a format that can be written."""
    if _format_of(path).encoded is None:
        raise RecordingError(f"{path}: files ending in {path.suffix} can be read but not written; write {_WRITTEN}.")


def _format_of(path: Path) -> FileFormat:
    for file_format in FORMATS:
        if file_format.marker and path.is_dir() and (path / file_format.marker).is_file():
            return file_format
    by_ending = {ending: file_format for file_format in FORMATS for ending in file_format.endings}
    if path.suffix.lower() not in by_ending:
        kind = f"files ending in {path.suffix}" if path.suffix else "files without an ending"
        advice = next((what for endings, what in _ADVICE if path.suffix.lower() in endings), _RENAME)
        raise RecordingError(f"{path}: {kind} are not known; {advice}; known endings: {', '.join(by_ending)}.")
    return by_ending[path.suffix.lower()]


def check_file(path: Path) -> None:
    """Check that a file exists, is not empty, and has the ending of a known format.

    Raises:
        RecordingError: it is a folder, empty, or of an unknown kind.
        FileNotFoundError: there is no such file.
    """
    markers = [file_format.marker for file_format in FORMATS if file_format.marker]
    if path.is_dir() and not any((path / marker).is_file() for marker in markers):
        raise RecordingError(f"{path}: this is a folder; name a file in it.")
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file.")
    if path.is_file() and path.stat().st_size == 0:
        text = path.suffix.lower() in CSV.endings
        advice = "it must hold a header line and rows of numbers" if text else "record it again, or copy the whole file"
        raise RecordingError(f"{path}: the file is empty; {advice}.")
    _format_of(path)
