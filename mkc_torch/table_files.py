"""Files that hold tables: their cells as numbers, and clear sentences about those that do not."""

from __future__ import annotations

import codecs
import csv
import io
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

SEPARATORS = {",": "comma", ";": "semicolon", "\t": "tab"}
_MISSING_WORDS = ["na", "n/a", "null"]
_MISSING = ["", "nan", "-nan", *_MISSING_WORDS]  # in lower case; C's printf writes -nan


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


def read_table(path: Path) -> Table:
    """The table in a file; at least one of its columns has a name.

    Raises:
        RecordingError: no file of a known kind, or a damaged or empty one.
        FileNotFoundError: no such file.
    """
    _check_file(path)
    table = _reader(path)(path)
    if not any(table.names):
        raise RecordingError(f"{path}: no column has a name; the first line must hold the column names.")
    return table


def encoded(path: Path, columns: Mapping[str, np.ndarray]) -> str | bytes:
    """The content of a table file of the kind that the ending of ``path`` says."""
    if path.suffix.lower() == ".parquet":
        buffer = io.BytesIO()
        _polars().DataFrame(dict(columns)).write_parquet(buffer)
        return buffer.getvalue()
    if all(_is_number(name) for name in columns):
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


def check_ending(path: Path) -> None:
    """Refuse a file whose ending says no known kind of table."""
    _reader(path)


def _reader(path: Path) -> Callable[[Path], Table]:
    if path.suffix.lower() not in _READERS:
        kind = f"files ending in {path.suffix}" if path.suffix else "files without an ending"
        raise RecordingError(f"{path}: {kind} are not known; known are {', '.join(_READERS)}.")
    return _READERS[path.suffix.lower()]


def _polars() -> Any:
    try:
        import polars
    except ImportError as error:
        raise ImportError('Tables are read with polars; install it with `pip install "mkc-torch[cli]"`.') from error
    return polars


def _check_file(path: Path) -> None:
    if path.is_dir():
        raise RecordingError(f"{path}: this is a folder; name the file in it.")
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file.")
    if path.is_file() and path.stat().st_size == 0:
        raise RecordingError(f"{path}: the file is empty; it must hold a header line and rows of numbers.")


def _read_csv(path: Path) -> Table:
    polars = _polars()
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
    if all(_is_number(name) for name in names):
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
        frame = polars.read_csv(body, separator=separator, has_header=False, infer_schema=False)
    except polars.exceptions.PolarsError as error:
        raise RecordingError(f"{path}: the table cannot be read: {str(error).splitlines()[0]}") from error
    return Table(names, frame.get_columns(), [number for number, _ in rows])


def _cells(line: str, separator: str) -> list[str]:
    return next(csv.reader([line], delimiter=separator))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return text.lower() not in _MISSING


def _read_parquet(path: Path) -> Table:
    polars = _polars()
    try:
        frame = polars.read_parquet(io.BytesIO(path.read_bytes()))  # a path would be a pattern
    except polars.exceptions.PolarsError as error:
        raise RecordingError(
            f"{path}: this is no Parquet file, or a damaged one: {str(error).splitlines()[0]}"
        ) from error
    if not len(frame):
        raise RecordingError(f"{path}: the table has no rows.")
    return Table([name.strip() for name in frame.columns], frame.get_columns(), range(1, len(frame) + 1), "row")


def renamed(table: Table, columns: Mapping[str, str], path: Path) -> tuple[dict[str, Any], list[str]]:
    """The named columns under their new names, and sentences about those left out."""
    warnings = []
    repeated = [name for name, count in Counter(table.names).items() if name and count > 1]
    if repeated:
        raise RecordingError(f"{path}: the header names {listed(repeated)} more than once; each name must be unique.")
    present = {name: series for name, series in zip(table.names, table.series, strict=True) if name}
    if nameless := len(table.names) - len(present):
        warnings.append(f"{counted(nameless, 'column')} without a name left out.")
    sources = {new: old.strip() for new, old in columns.items()}
    for new, old in sources.items():
        if old not in present:
            raise MissingColumnError(
                f"{path}: there is no column `{old}` to be `{new}`; the file has {listed(present)}."
            )
    names: dict[str, Any] = {}
    for name, series in present.items():
        new_names = [new for new, old in sources.items() if old == name]
        if not new_names and name in sources:
            warnings.append(f"Column `{name}` of the file is left out: `{sources[name]}` takes its name.")
        elif not new_names:
            new_names = [name]
        names |= dict.fromkeys(new_names, series)
    return names, warnings


def as_numbers(series: Any) -> tuple[Any, Any]:
    """A column as numbers, null where there is none, and where something else than a missing value stands there."""
    polars = _polars()
    if series.dtype == polars.String:
        text = series.str.strip_chars()
        missing = text.is_null() | text.str.to_lowercase().is_in(_MISSING)
        numbers = text.cast(polars.Float64, strict=False)
        return numbers, numbers.is_null() & ~missing
    if series.dtype.is_numeric() or series.dtype in (polars.Boolean, polars.Null):
        return series.cast(polars.Float64), polars.repeat(False, len(series), dtype=polars.Boolean, eager=True)
    return polars.repeat(None, len(series), dtype=polars.Float64, eager=True), series.is_not_null()


def missing_warning(table: Table, name: str, series: Any) -> str | None:
    """A sentence about words that stand for missing values, such as n/a; what is empty or nan speaks for itself."""
    polars = _polars()
    if series.dtype != polars.String:
        return None
    cells = series.str.strip_chars()
    words = cells.str.to_lowercase().is_in(_MISSING_WORDS)
    count = int(words.sum() or 0)
    if not count:
        return None
    row = int(words.fill_null(False).arg_max())
    return (
        f'Column `{name}` holds "{cells[row]}" or the like {counted(count, "time")}, first at {table.line} '
        f"{table.lines[row]}; it is read as no value."
    )


def numbered(series: Any) -> tuple[Any, list[str]]:
    """Labels as 0, 1, … in the order of appearance, and the labels."""
    polars = _polars()
    cells = [None if cell is None else str(cell).strip() for cell in series.to_list()]
    numbers = {label: float(i) for i, label in enumerate(dict.fromkeys(cell for cell in cells if cell))}
    return polars.Series([numbers.get(cell or "") for cell in cells], dtype=polars.Float64), list(numbers)


def text_error(path: Path, table: Table, name: str, series: Any, row: int) -> RecordingError:
    text = str(series[row]).strip()
    kind = "text" if series.dtype == _polars().String else "no number"
    advice = "correct it, or write nan where there is no value"
    if _is_number(text.replace(",", ".")):
        advice = "write decimals with a point"
    elif name == "time":
        advice = "times are numbers, in seconds"
    shown = text if len(text) <= 40 else text[:39] + "…"
    return RecordingError(
        f'{path}: column `{name}` holds {kind} at {table.line} {table.lines[row]}, "{shown}"; {advice}.'
    )


def listed(names: Iterable[str]) -> str:
    """Column names for a sentence."""
    return ", ".join(f"`{name}`" for name in names)


def counted(count: int, what: str) -> str:
    """A number of things for a sentence."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


_READERS: dict[str, Callable[[Path], Table]] = {
    ".csv": _read_csv,
    ".tsv": _read_csv,
    ".txt": _read_csv,
    ".parquet": _read_parquet,
}
