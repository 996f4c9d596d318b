"""What every file format has in common: a table as read, the format itself, and words about them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

__all__ = [
    "FileFormat",
    "MissingColumnError",
    "RecordingError",
    "Table",
    "Topic",
    "counted",
    "is_number",
    "listed",
    "polars",
]

MISSING_WORDS = [
    "na", "n/a", "null", "none", "nil", "<na>", "#n/a", "#na", "#value!", "#num!", "#div/0!", "1.#qnan", "-1.#ind",
    "1.#ind",
]  # fmt: skip
MISSING_SIGNS = ["-", "--", "---", "?"]
"""What stands for a missing value among numbers; elsewhere it may be a name or a unit."""

MISSING = ["", "nan", "-nan", *MISSING_WORDS]
"""Cells without a value, in lower case; C's printf writes -nan."""


class RecordingError(ValueError):
    """A recording that cannot be used; the sentence says which, why, and what to do."""


class MissingColumnError(RecordingError):
    """A column that a recording does not have."""


class Table(NamedTuple):
    """A file as read: column names as in the file (empty where there is none), polars Series, where rows came from."""

    names: list[str]
    series: list[Any]
    lines: Sequence[int]
    line: str = "line"


class Topic(NamedTuple):
    """One of the tables of a file: a topic of a log, a group of measurements, or the whole of a CSV.

    Attributes:
        name: as the file has it, such as ``sensor_mag_0`` or ``/imu/mag``; empty where a file holds one table alone.
        table: its columns, among them the one that holds its own time.
        units: of columns, as the format writes them, where it does: ``{"timestamp": "us", "x": "gauss"}``.
        warnings: sentences about what was found or dropped while it was read.
        restarts: rows, from 0, before which the file says that the logger started anew.
    """

    name: str
    table: Table
    units: Mapping[str, str] = MappingProxyType({})
    warnings: tuple[str, ...] = ()
    restarts: tuple[int, ...] = ()


class FileFormat(NamedTuple):
    """A kind of file that holds tables; a new one is a file of this folder and an entry in ``FORMATS``.

    Attributes:
        endings: of its files, in lower case.
        topics: the tables in a file, at least one; raises :class:`RecordingError` where it is damaged or empty.
        encoded: the content of a file with these columns; None of a format that is only read.
        marker: a file that lies in a folder of this kind, where the recording is a folder.
    """

    endings: tuple[str, ...]
    topics: Callable[[Path], list[Topic]]
    encoded: Callable[[Path, Mapping[str, np.ndarray]], str | bytes] | None = None
    marker: str = ""


def polars() -> Any:
    try:
        import polars as package
    except ImportError as error:
        raise ImportError('Tables are read with polars; install it with `pip install "mkc-torch[cli]"`.') from error
    return package


def is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return text.lower() not in MISSING


def listed(names: Iterable[str]) -> str:
    """Column names for a sentence."""
    return ", ".join(f"`{name}`" for name in names)


def counted(count: int, what: str) -> str:
    """A number of things for a sentence."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"
