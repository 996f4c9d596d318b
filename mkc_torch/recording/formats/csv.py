"""Text with separators: CSV, TSV and TXT, of any dialect that can be told with certainty."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mkc_torch.recording.formats.base import FileFormat, RecordingError, Table, Topic, is_number, listed, polars
from mkc_torch.recording.formats.text_cells import WHITE, cells_of
from mkc_torch.recording.formats.text_layout import layout_of
from mkc_torch.recording.formats.text_lines import Line, lines_of
from mkc_torch.recording.formats.text_numbers import without_thousands, without_units

__all__ = ["CSV"]

_COMMA = r"^\s*[+-]?(\d+,\d*|,\d+)([eE][+-]?\d+)?\s*$"
_POINT = r"^\s*[+-]?(\d+\.\d*|\.\d+)([eE][+-]?\d+)?\s*$"
_THOUSANDS = r"^\s*[+-]?[1-9]\d{0,2},\d{3}\s*$"

_COMMA_SECONDS = re.compile(r"(?<=\d:\d\d:\d\d),(?=\d{1,9}(?:,|\s*$))")
"""As Python's logging writes times."""

_EXAMPLE = "add a first line such as time,mag_x,mag_y,mag_z"

_BOTH_SIGNS = 5
"""Rows of either sign from which a column is taken to go through nought."""


def topic(path: Path) -> Topic:
    """The table in a text file, its cells as text.

    Raises:
        RecordingError: it is no table, or one whose cells cannot be told from one another.
    """
    package = polars()
    lines, warnings = lines_of(path)
    lines, more = _plainly_quoted(lines)
    warnings += more
    layout = layout_of(path, lines)
    names = [name.strip() for name in layout.names]
    if all(is_number(name) for name in names):
        raise RecordingError(f"{path}: the first line holds numbers; it must hold the column names: {_EXAMPLE}.")
    body, separator = _body(layout.rows, layout.separator)
    try:
        frame = package.read_csv(body, separator=separator, has_header=False, infer_schema=False)
    except package.exceptions.PolarsError as error:
        raise RecordingError(f"{path}: the table cannot be read: {str(error).splitlines()[0]}") from error
    numbers = [line.number for line in layout.rows]
    grouped, thousands = without_thousands(frame.get_columns())
    series, told = _with_points(path, names, grouped, numbers)
    told = ["Signs between thousands were taken out of the numbers.", *told] if thousands else told
    bare = [without_units(one) for one in series]
    series = [one for one, _ in bare]
    units = {name: unit for name, (_, unit) in zip(names, bare, strict=True) if unit}
    units |= {
        name: unit.strip(" []()") for name, unit in zip(names, layout.units, strict=False) if unit.strip(" -[]()")
    }
    return Topic("", Table(names, series, numbers), units, (*warnings, *layout.warnings, *told), layout.restarts)


def _plainly_quoted(lines: list[Line]) -> tuple[list[Line], list[str]]:
    """Lines whose cells are not in single quotes, nor have commas before the parts of a second, and what was done."""
    told = []
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
            told.append("A comma before the parts of a second was read as a point.")
    return lines, told


def _body(rows: list[Line], separator: str) -> tuple[bytes, str]:
    """The rows as one text for the parser, and its separator."""
    if separator != WHITE:
        return "\n".join(line.text for line in rows).encode(), separator
    return "\n".join("\t".join(cells_of(line.text, separator)) for line in rows).encode(), "\t"


def _with_points(path: Path, names: list[str], series: list[Any], lines: list[int]) -> tuple[list[Any], list[str]]:
    """Columns with decimal commas, with points instead, where all of a file is written so.

    Raises:
        RecordingError: the commas may as well set off thousands.
    """
    if any(bool(one.str.contains(_POINT).any()) for one in series):
        return series, []
    commas = [one.str.contains(_COMMA) for one in series]
    with_commas = [one for one, has in zip(series, commas, strict=True) if bool(has.any())]
    if not with_commas:
        return series, []
    if all(_may_be_thousands(one.filter(one.str.contains(_COMMA)), len(one)) for one in with_commas):
        place, has = next((i, has) for i, has in enumerate(commas) if bool(has.any()))
        row = int(has.fill_null(False).arg_max())
        raise RecordingError(
            f'{path}: column `{names[place]}` holds "{series[place][row].strip()}" at line {lines[row]}, and so is '
            "every comma of the file before three digits: they may be decimals or thousands; write decimals with a "
            "point."
        )
    changed = [
        one.str.replace(",", ".", literal=True) if bool(has.any()) else one
        for one, has in zip(series, commas, strict=True)
    ]
    return changed, ["Decimal commas were read as points."]


def _may_be_thousands(cells: Any, rows: int) -> bool:
    """Whether the commas of a column may set off thousands: always before three digits.

    Not where every row has one and the signs differ: no quantity goes through nought without a number below 1000.
    """
    if not bool(cells.str.contains(_THOUSANDS).all()):
        return False
    negative = int(cells.str.contains(r"^\s*-").sum())
    return not (len(cells) == rows and min(negative, rows - negative) >= _BOTH_SIGNS)


def encoded(path: Path, columns: Mapping[str, np.ndarray]) -> str | bytes:
    """The content of a file with these columns; the ending .tsv asks for tabs."""
    if all(is_number(name) for name in columns):
        raise RecordingError(f"{path}: a header of numbers alone, {listed(columns)}, reads as none; use words.")
    text = io.StringIO()
    separator = "\t" if path.suffix.lower() == ".tsv" else ","
    header: Literal[0, 1] = csv.QUOTE_ALL if _needs_quotes(list(columns)) else csv.QUOTE_MINIMAL
    csv.writer(text, delimiter=separator, lineterminator="\n", quoting=header).writerow(columns)
    writer = csv.writer(text, delimiter=separator, lineterminator="\n")
    # repr, which csv uses for floats, is the shortest text that reads back as the same number
    writer.writerows(zip(*(values.tolist() for values in columns.values()), strict=True))
    return text.getvalue()


def _needs_quotes(names: Sequence[str]) -> bool:
    """The reader finds separators outside quotes, and takes a line that begins with certain signs for a comment."""
    return any(re.search(r'[,;\t|"]', name) for name in names) or names[0].startswith(("#", "%", "//"))


CSV = FileFormat((".csv", ".tsv", ".txt", ".dat", ".asc"), lambda path: [topic(path)], encoded)
