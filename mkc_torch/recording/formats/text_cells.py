"""Split lines of text into cells, and classify the cells."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence

from mkc_torch.recording.formats.base import MISSING
from mkc_torch.recording.formats.text_numbers import is_written_number

WHITE = " "
SEPARATORS = {",": "comma", ";": "semicolon", "\t": "tab", "|": "bar", WHITE: "space"}

_ORDER = ("\t", ";", "|", ",", WHITE)
"""Precedence of separators that explain a table equally well."""

_BLANKS = 0.9
"""Score factor of blanks as separators; a stamp of date and time contains a blank."""

_WITHOUT_NAMES = 0.6
"""Score factor of a separator that splits no line of words into as many cells as the rows, as it does a header."""

_LOOKED_AT = 120
"""Number of lines at the beginning, and in the middle, from which the separator is detected."""

_NUMBER = re.compile(r"[+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d+)?|[+-]?(inf|infinity)", re.IGNORECASE)
_DATE = r"\d{4}-\d\d-\d\d|\d{4}([/.]\d{1,2}){2}|(\d{1,2}[/.]){2}\d{4}|\d{1,2}-[A-Za-z]{3}-\d{4}"
_OF_DAY = r"(\d{1,2}:\d\d(:\d\d([.,]\d+)?)?(\s?[AaPp]\.?[Mm]\.?)?|\d{1,3}:\d\d[.,]\d+)"
_STAMP = re.compile(rf"({_DATE})(,?[T ]\s*\d{{1,2}}.*)?|\d{{8}}T\d\d.*|{_OF_DAY}")
_WHITE_WORDS = re.compile(r'"[^"]*"|[^\s"]+(?:\s*[\[(][^\])]*[\])])?')
"""Words between blanks; a unit in brackets belongs to the word before it."""


def cells_of(line: str, separator: str) -> list[str]:
    """The cells of a line, without quotes."""
    if separator == WHITE:
        return [word.strip('"') for word in _WHITE_WORDS.findall(line)]
    if '"' not in line:
        return line.split(separator)
    return next(csv.reader([line], delimiter=separator))


def count_of(line: str, separator: str) -> int:
    """The number of cells of a line."""
    if separator == WHITE or '"' in line:
        return len(cells_of(line, separator))
    return line.count(separator) + 1


def is_value(cell: str) -> bool:
    """Whether a cell holds a number, a time stamp, or a word for a missing value.

    Example:
        >>> [is_value(cell) for cell in ("-1.5e3", "0,5", "2024-05-03T10:00:00Z", "nan", "", "mag_x", "1_000")]
        [True, True, True, True, False, False, False]
    """
    cell = cell.strip()
    return bool(cell) and (
        _NUMBER.fullmatch(cell) is not None
        or cell.lower() in MISSING
        or _STAMP.fullmatch(cell) is not None
        or is_written_number(cell)
    )


def is_stamp(cell: str) -> bool:
    """Whether a cell holds a date, a time of the day, or both."""
    return _STAMP.fullmatch(cell.strip()) is not None


def is_date(cell: str) -> bool:
    """Whether a cell holds only a date."""
    return re.fullmatch(_DATE, cell.strip()) is not None


def is_time_of_day(cell: str) -> bool:
    """Whether a cell holds only a time of the day."""
    return re.fullmatch(_OF_DAY, cell.strip()) is not None


def separator_of(lines: Sequence[str]) -> tuple[str, int]:
    """The separator that splits most lines into equally many cells with values, and that number of cells.

    Example:
        >>> separator_of(["time;mag", "0,1;2,5", "0,2;2,6"])
        (';', 2)
    """
    half = len(lines) // 2
    seen = [*lines[:_LOOKED_AT], *lines[max(_LOOKED_AT, half) : max(_LOOKED_AT, half) + _LOOKED_AT]]
    best, found = 0.0, None
    for separator in _ORDER:
        split = [cells_of(line, separator) for line in seen]
        rows = [cells for cells in split if any(map(is_value, cells))]
        if not rows:
            continue
        (count, _), *_ = Counter(map(len, rows)).most_common(1)
        if count < 2:
            continue
        rows = [cells for cells in rows if len(cells) == count]
        filled = sum(any(cells[i].strip() for cells in rows) for i in range(count))
        score = sum(sum(map(is_value, cells)) / filled for cells in rows) * (_BLANKS if separator == WHITE else 1.0)
        if not any(len(cells) == count and not any(map(is_value, cells)) for cells in split):
            score *= _WITHOUT_NAMES
        if score > best:
            best, found = score, (separator, count)
    if found is not None:
        return found
    separator = max((sign for sign in SEPARATORS if sign != WHITE), key=re.sub('"[^"]*"', "", seen[0]).count)
    return separator, count_of(seen[0], separator)
