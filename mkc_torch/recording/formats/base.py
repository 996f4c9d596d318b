"""What every file format has in common: a table as read, the format itself, and words about them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

__all__ = ["FileFormat", "MissingColumnError", "RecordingError", "Table", "counted", "is_number", "listed", "polars"]

MISSING_WORDS = ["na", "n/a", "null"]
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


class FileFormat(NamedTuple):
    """A kind of file that holds a table; a new one is a file of this folder and an entry in ``FORMATS``.

    Attributes:
        endings: of its files, in lower case.
        read: the table in a file; raises :class:`RecordingError` where it is damaged or empty.
        encoded: the content of a file with these columns.
    """

    endings: tuple[str, ...]
    read: Callable[[Path], Table]
    encoded: Callable[[Path, Mapping[str, np.ndarray]], str | bytes]


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
