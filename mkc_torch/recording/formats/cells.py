"""Convert the columns of a table to numbers, with errors and warnings about other cells."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mkc_torch._support.note import Note
from mkc_torch.recording.formats.base import (
    MISSING,
    MISSING_SIGNS,
    MISSING_WORDS,
    MissingColumnError,
    RecordingError,
    Table,
    counted,
    is_number,
    listed,
    polars,
)


def renamed(
    table: Table, columns: Mapping[str, str], path: Path | str, what: str = "file"
) -> tuple[dict[str, Any], list[str]]:
    """Rename columns; returns the named columns by new name, and warnings about columns left out."""
    warnings: list[str] = []
    repeated = [name for name, count in Counter(table.names).items() if name and count > 1]
    if repeated:
        raise RecordingError(f"{path}: the header names {listed(repeated)} more than once; each name must be unique.")
    present = {name: series for name, series in zip(table.names, table.series, strict=True) if name}
    if nameless := len(table.names) - len(present):
        warnings.append(Note(f"{counted(nameless, 'column')} without a name left out."))
    sources = {new: old.strip() for new, old in columns.items()}
    for new, old in sources.items():
        if old not in present:
            raise MissingColumnError(
                f"{path}: there is no column `{old}` to use as `{new}`; the {what} has {listed(present)}."
            )
    names: dict[str, Any] = {}
    for name, series in present.items():
        new_names = [new for new, old in sources.items() if old == name]
        if not new_names and name in sources:
            warnings.append(Note(f"Column `{name}` of the {what} is left out: `{sources[name]}` takes its name."))
        elif not new_names:
            new_names = [name]
        names |= dict.fromkeys(new_names, series)
    return names, warnings


def as_numbers(series: Any) -> tuple[Any, Any]:
    """A column as numbers, null if missing, and the mask of cells that are neither numbers nor missing values."""
    package = polars()
    if series.dtype == package.String:
        numbers = series.cast(package.Float64, strict=False)
        if not numbers.null_count():
            return numbers, package.repeat(False, len(series), dtype=package.Boolean, eager=True)
        text = series.str.strip_chars()
        missing = text.is_null() | text.str.to_lowercase().is_in([*MISSING, *MISSING_SIGNS])
        numbers = text.cast(package.Float64, strict=False)
        return numbers, numbers.is_null() & ~missing
    if series.dtype.is_numeric() or series.dtype in (package.Boolean, package.Null):
        return series.cast(package.Float64), package.repeat(False, len(series), dtype=package.Boolean, eager=True)
    return package.repeat(None, len(series), dtype=package.Float64, eager=True), series.is_not_null()


def missing_warning(table: Table, name: str, series: Any) -> str | None:
    """A warning about words that were read as missing values, such as n/a; None for empty cells and nan only."""
    package = polars()
    if series.dtype != package.String:
        return None
    cells = series.str.strip_chars()
    words = cells.str.to_lowercase().is_in([*MISSING_WORDS, *MISSING_SIGNS])
    count = int(words.sum() or 0)
    if not count:
        return None
    row = int(words.fill_null(False).arg_max())
    return Note(
        f'Column `{name}` holds "{cells[row]}" or the like {counted(count, "time")}, first at {table.line} '
        f"{table.lines[row]}; it is read as a missing value."
    )


def numbered(series: Any) -> tuple[Any, list[str]]:
    """Number labels 0, 1, … in the order of appearance; returns the numbers and the labels."""
    package = polars()
    cells = [None if cell is None else str(cell).strip() for cell in series.to_list()]
    numbers = {label: float(i) for i, label in enumerate(dict.fromkeys(cell for cell in cells if cell))}
    return package.Series([numbers.get(cell or "") for cell in cells], dtype=package.Float64), list(numbers)


def text_error(path: Path, table: Table, name: str, series: Any, row: int, advice: str = "") -> RecordingError:
    """The error about a cell that does not hold a number, with its line and a remedy."""
    text = str(series[row]).strip()
    kind = "text" if series.dtype == polars().String else "no number"
    if "," in text and is_number(text.replace(",", ".")):
        advice = "write decimals with a point"
    advice = advice or "correct it, or write nan for a missing value"
    shown = text if len(text) <= 40 else text[:39] + "…"
    return RecordingError(
        f'{path}: column `{name}` holds {kind} at {table.line} {table.lines[row]}, "{shown}"; {advice}.'
    )
