"""Text with separators: CSV, TSV and TXT."""

from __future__ import annotations

import codecs
import csv
import io
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np

from mkc_torch.recording.formats.base import (
    FileFormat,
    RecordingError,
    Table,
    Topic,
    counted,
    is_number,
    listed,
    polars,
)

__all__ = ["CSV"]

SEPARATORS = {",": "comma", ";": "semicolon", "\t": "tab"}


def read(path: Path) -> Table:
    """The table in a text file, its cells as text."""
    package = polars()
    try:
        with path.open(encoding="utf-8-sig") as file:
            rows = [(number, line.rstrip("\n")) for number, line in enumerate(file, start=1) if line.strip(" \r\n")]
    except UnicodeDecodeError as error:
        begin = path.read_bytes()[:2]
        found = " but begins as UTF-16 does" if begin in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) else ""
        raise RecordingError(f"{path}: the file is not UTF-8 text{found}; export it as CSV in UTF-8.") from error
    if not rows:
        raise RecordingError(f"{path}: the file is empty; it must hold a header line and rows of numbers.")
    header = rows.pop(0)[1]
    separator = max(SEPARATORS, key=re.sub('"[^"]*"', "", header).count)
    names = [name.strip() for name in _cells(header, separator)]
    if all(is_number(name) for name in names):
        raise RecordingError(f"{path}: the first line holds numbers; it must hold the column names.")
    if not rows:
        raise RecordingError(f"{path}: the file has a header line but no rows of numbers.")
    for number, line in rows:
        count = len(_cells(line, separator)) if '"' in line else line.count(separator) + 1
        if count != len(names):
            advice = (
                "correct or remove that line"
                if len(names) > 1
                else "the first line must hold the column names: remove what stands above them"
            )
            raise RecordingError(
                f"{path}: line {number} has {counted(count, 'value')} but the header names "
                f"{counted(len(names), 'column')} (the separator is the {SEPARATORS[separator]}); {advice}."
            )
    body = "\n".join(line for _, line in rows).encode()
    try:
        frame = package.read_csv(body, separator=separator, has_header=False, infer_schema=False)
    except package.exceptions.PolarsError as error:
        raise RecordingError(f"{path}: the table cannot be read: {str(error).splitlines()[0]}") from error
    return Table(names, frame.get_columns(), [number for number, _ in rows])


def encoded(path: Path, columns: Mapping[str, np.ndarray]) -> str | bytes:
    """The content of a file with these columns; the ending .tsv asks for tabs."""
    if all(is_number(name) for name in columns):
        raise RecordingError(f"{path}: a header of numbers alone, {listed(columns)}, reads as none; use words.")
    text = io.StringIO()
    separator = "\t" if path.suffix.lower() == ".tsv" else ","
    # the reader finds the separator outside quotes
    quoted = any(mark in name for name in columns for mark in (*SEPARATORS, '"'))
    header: Literal[0, 1] = csv.QUOTE_ALL if quoted else csv.QUOTE_MINIMAL
    csv.writer(text, delimiter=separator, lineterminator="\n", quoting=header).writerow(columns)
    writer = csv.writer(text, delimiter=separator, lineterminator="\n")
    # repr, which csv uses for floats, is the shortest text that reads back as the same number
    writer.writerows(zip(*(values.tolist() for values in columns.values()), strict=True))
    return text.getvalue()


def _cells(line: str, separator: str) -> list[str]:
    return next(csv.reader([line], delimiter=separator))


CSV = FileFormat((".csv", ".tsv", ".txt"), lambda path: [Topic("", read(path))], encoded)
