"""Read and write text with separators: CSV, TSV and TXT, with detected separators and decimals."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mkc_torch._support.note import Note
from mkc_torch.recording.formats.base import FileFormat, RecordingError, Table, Topic, is_number, listed, polars
from mkc_torch.recording.formats.plain_table import PlainTable, plain_table
from mkc_torch.recording.formats.text_cells import WHITE, cells_of
from mkc_torch.recording.formats.text_layout import Layout, layout_of
from mkc_torch.recording.formats.text_lines import Line, lines_of
from mkc_torch.recording.formats.text_numbers import without_thousands, without_units

_COMMA = r"^\s*[+-]?(\d+,\d*|,\d+)([eE][+-]?\d+)?\s*$"
_POINT = r"^\s*[+-]?(\d+\.\d*|\.\d+)([eE][+-]?\d+)?\s*$"
_THOUSANDS = r"^\s*[+-]?[1-9]\d{0,2},\d{3}\s*$"

_COMMA_SECONDS = re.compile(r"(?<=\d:\d\d:\d\d),(?=\d{1,9}(?:,|\s*$))")
"""A comma before the fraction of a second, as Python's logging writes times."""

_EXAMPLE = "add a first line such as time,mag_x,mag_y,mag_z"

_BOTH_SIGNS = 5
"""Fewest rows of either sign in a column that passes through zero."""


def topic(path: Path) -> Topic:
    """Read the table of a text file, with its cells as text.

    Raises:
        RecordingError: the file is not a table, or its cells are ambiguous.
    """
    plain = plain_table(path, layout_of)
    if plain is not None:
        return _of_plain(path, plain)
    package = polars()
    lines, warnings = lines_of(path)
    lines, more = _plainly_quoted(lines)
    warnings += more
    layout = layout_of(path, lines)
    names = _names(path, layout)
    body, separator = _body(layout.rows, layout.separator)
    try:
        frame = package.read_csv(body, separator=separator, has_header=False, infer_schema=False)
    except package.exceptions.PolarsError as error:
        raise RecordingError(f"{path}: the table cannot be read: {str(error).splitlines()[0]}") from error
    numbers = [line.number for line in layout.rows]
    grouped, thousands = without_thousands(frame.get_columns())
    series, changes = _with_points(path, names, grouped, numbers)
    changes = [Note("Thousands separators were removed from the numbers."), *changes] if thousands else changes
    bare = [without_units(column) for column in series]
    units = {name: unit for name, (_, unit) in zip(names, bare, strict=True) if unit}
    units |= _stated_units(names, layout)
    table = Table(names, [column for column, _ in bare], numbers, with_units=series)
    return Topic("", table, units, (*warnings, *layout.warnings, *changes), layout.restarts)


def _names(path: Path, layout: Layout) -> list[str]:
    names = [name.strip() for name in layout.names]
    if all(is_number(name) for name in names):
        raise RecordingError(f"{path}: the first line holds numbers; it must hold the column names: {_EXAMPLE}.")
    return names


def _stated_units(names: Sequence[str], layout: Layout) -> dict[str, str]:
    """The units of the row of units, by column."""
    pairs = zip(names, layout.units, strict=False)
    return {name: unit.strip(" []()") for name, unit in pairs if unit.strip(" -[]()")}


def _of_plain(path: Path, plain: PlainTable) -> Topic:
    """The table of a long file of plain numbers, whose cells have no units, quotes or thousands separators."""
    layout = plain.layout
    names = _names(path, layout)
    frame = polars().read_csv(plain.body, separator=layout.separator, has_header=False, infer_schema=False)
    first = layout.rows[0].number
    table = Table(names, frame.get_columns(), range(first, first + plain.rows))
    return Topic("", table, _stated_units(names, layout), tuple(layout.warnings))


def _plainly_quoted(lines: list[Line]) -> tuple[list[Line], list[str]]:
    """Replace single quotes by double quotes, and decimal commas in time stamps by points; returns warnings too."""
    warnings: list[str] = []
    if len(lines) > 1 and all(
        line.text[:1] == line.text.rstrip()[-1:] == "'" and '"' not in line.text for line in lines
    ):
        lines = [line._replace(text=line.text.replace("'", '"')) for line in lines]
    stamped = [line for line in lines if _COMMA_SECONDS.search(line.text)]
    if 2 * len(stamped) > len(lines):
        row, names = stamped[len(stamped) // 2].text, [line.text for line in lines if line not in stamped]
        commas = row.count(",") - len(_COMMA_SECONDS.findall(row))
        if row.count(";") + row.count("\t") == 0 and any(name.count(",") == commas for name in names[:20]):
            lines = [line._replace(text=_COMMA_SECONDS.sub(".", line.text)) for line in lines]
            warnings.append(Note("A comma before the fraction of a second was read as a point."))
    return lines, warnings


def _body(rows: list[Line], separator: str) -> tuple[bytes, str]:
    """Join the rows to a text for the parser; returns the text and its separator."""
    if separator != WHITE:
        return "\n".join(line.text for line in rows).encode(), separator
    return "\n".join("\t".join(cells_of(line.text, separator)) for line in rows).encode(), "\t"


def _with_points(path: Path, names: list[str], series: list[Any], lines: list[int]) -> tuple[list[Any], list[str]]:
    """Replace decimal commas by points if the file has no decimal points; returns columns and warnings.

    Raises:
        RecordingError: the commas may also be thousands separators.
    """
    if any(bool(column.str.contains(_POINT).any()) for column in series):
        return series, []
    commas = [column.str.contains(_COMMA) for column in series]
    with_commas = [column for column, has in zip(series, commas, strict=True) if bool(has.any())]
    if not with_commas:
        return series, []
    if all(_may_be_thousands(column.filter(column.str.contains(_COMMA)), len(column)) for column in with_commas):
        place, has = next((i, has) for i, has in enumerate(commas) if bool(has.any()))
        row = int(has.fill_null(False).arg_max())
        raise RecordingError(
            f'{path}: column `{names[place]}` holds "{series[place][row].strip()}" at line {lines[row]}, and every '
            "comma of the file is before three digits, so that it may mark decimals or thousands; write decimals with "
            "a point."
        )
    changed = [
        column.str.replace(",", ".", literal=True) if bool(has.any()) else column
        for column, has in zip(series, commas, strict=True)
    ]
    return changed, [Note("Decimal commas were read as points.")]


def _may_be_thousands(cells: Any, rows: int) -> bool:
    """Whether the commas of a column may be thousands separators: each is followed by three digits.

    They are decimals if every row has a comma and the signs differ: a quantity that passes through zero has values
    below 1000.
    """
    if not bool(cells.str.contains(_THOUSANDS).all()):
        return False
    negative = int(cells.str.contains(r"^\s*-").sum())
    return not (len(cells) == rows and min(negative, rows - negative) >= _BOTH_SIGNS)


def encoded(path: Path, columns: Mapping[str, np.ndarray]) -> str | bytes:
    """Encode columns as text; the ending .tsv selects tabs as separators."""
    text = io.StringIO(_header(path, list(columns)))
    text.seek(0, io.SEEK_END)
    writer = csv.writer(text, delimiter=_separator(path), lineterminator="\n")
    # csv writes floats by repr, the shortest text that is read back as the same number
    writer.writerows(zip(*(values.tolist() for values in columns.values()), strict=True))
    return text.getvalue()


def encoded_series(path: Path, columns: Mapping[str, Any]) -> bytes:
    """Encode polars series as text, as :func:`encoded` does arrays; null is an empty cell."""
    frame = polars().DataFrame([series.alias(str(place)) for place, series in enumerate(columns.values())])
    text = io.BytesIO()
    text.write(_header(path, list(columns)).encode())
    frame.write_csv(text, include_header=False, separator=_separator(path), quote_style="necessary")
    return text.getvalue()


def _separator(path: Path) -> str:
    return "\t" if path.suffix.lower() == ".tsv" else ","


def _header(path: Path, names: Sequence[str]) -> str:
    """The line of column names."""
    if all(is_number(name) for name in names):
        raise RecordingError(
            f"{path}: the column names {listed(names)} are all numbers and would be read as data; use words."
        )
    text = io.StringIO()
    quoting: Literal[0, 1] = csv.QUOTE_ALL if _needs_quotes(names) else csv.QUOTE_MINIMAL
    csv.writer(text, delimiter=_separator(path), lineterminator="\n", quoting=quoting).writerow(names)
    return text.getvalue()


def _needs_quotes(names: Sequence[str]) -> bool:
    """Whether names need quotes: they contain a separator, or the first name begins like a comment."""
    return any(re.search(r'[,;\t|"]', name) for name in names) or names[0].startswith(("#", "%", "//"))


CSV = FileFormat((".csv", ".tsv", ".txt", ".dat", ".asc"), lambda path: [topic(path)], encoded)
