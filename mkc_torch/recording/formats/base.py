"""Common types of all file formats: tables, topics, formats and errors; helpers for messages."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

MISSING_WORDS = [
    "na", "n/a", "null", "none", "nil", "<na>", "#n/a", "#na", "#value!", "#num!", "#div/0!", "1.#qnan", "-1.#ind",
    "1.#ind",
]  # fmt: skip
MISSING_SIGNS = ["-", "--", "---", "?"]
"""Signs that mark a missing value among numbers; elsewhere they may be a name or a unit."""

MISSING = ["", "nan", "-nan", *MISSING_WORDS]
"""Cells without a value, in lower case; C's printf writes -nan."""


class RecordingError(ValueError):
    """A recording cannot be used; the message states which, why, and what to do."""


class MissingColumnError(RecordingError):
    """A recording does not have this column."""


class Table(NamedTuple):
    """A table as read.

    Attributes:
        names: column names of the file, empty for a column without a name.
        series: polars series, a column each.
        lines: for each row, its line or row number in the file.
        line: the word for that number in messages: "line", "row" or "message".
        with_units: the columns with the units in their cells, as to be copied; ``series`` if None.
    """

    names: list[str]
    series: list[Any]
    lines: Sequence[int]
    line: str = "line"
    with_units: list[Any] | None = None


class LoggedCorrection(NamedTuple):
    """The correction that a logger applied to a magnetometer: ``logged = matrix (reading + offsets)``.

    Attributes:
        columns: the corrected columns x, y, z.
        names: names of its parameters, for messages.
        offsets: (N, 3), in the unit of the columns; None if unknown.
        matrix: (3, 3); None if unknown.
        unknown: why it is unknown, as the end of a sentence; empty if it is known.
    """

    columns: tuple[str, str, str]
    names: str
    offsets: np.ndarray | None = None
    matrix: np.ndarray | None = None
    unknown: str = ""


class Topic(NamedTuple):
    """A table of a file: a topic of a log, a group of measurements, or a whole CSV.

    Attributes:
        name: its name in the file, such as ``sensor_mag_0`` or ``/imu/mag``; empty if the file holds a single table.
        table: its columns, including its time.
        units: units that the format states, by column: ``{"timestamp": "us", "x": "gauss"}``.
        warnings: what was found or dropped while the table was read.
        restarts: row indices at which the logger restarted, by a repeated header.
        correction: correction of a magnetometer before its field was logged; None for a field as measured.
    """

    name: str
    table: Table
    units: Mapping[str, str] = MappingProxyType({})
    warnings: tuple[str, ...] = ()
    restarts: tuple[int, ...] = ()
    correction: LoggedCorrection | None = None


class UsualUnit(str):
    """A unit that all files of a format have in a column, although the file does not state it."""

    __slots__ = ()


class FileFormat(NamedTuple):
    """A file format; a new format is a module of this folder and an entry in ``FORMATS``.

    Attributes:
        endings: endings of its files, in lower case.
        topics: reads the tables of a file, at least one; raises :class:`RecordingError` if it is damaged or empty.
        encoded: encodes columns as the content of a file; None for a format that is only read.
        marker: name of a file that identifies a folder of this format; empty if its recordings are files.
    """

    endings: tuple[str, ...]
    topics: Callable[[Path], list[Topic]]
    encoded: Callable[[Path, Mapping[str, np.ndarray]], str | bytes] | None = None
    marker: str = ""


def polars() -> Any:
    """Import polars, or raise an ImportError that names its installation."""
    return optional("polars", "Tables", "cli")


def optional(module: str, files: str, extra: str) -> Any:
    """Import a module of an optional package.

    Raises:
        ImportError: it is not installed; the message names the files that it reads, and the extra to install.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise ImportError(
            f'{files} are read with {module.partition(".")[0]}; install it with `pip install "mkc-torch[{extra}]"`.'
        ) from error


def is_number(text: str) -> bool:
    """Whether a text is a number, and not nan or another word for a missing value."""
    try:
        float(text)
    except ValueError:
        return False
    return text.lower() not in MISSING


def listed(names: Iterable[str]) -> str:
    """Join column names for a message."""
    return ", ".join(f"`{name}`" for name in names)


def counted(count: int, what: str) -> str:
    """Format a count with its noun, in the singular or plural."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"
