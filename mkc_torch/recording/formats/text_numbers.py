"""Numbers in cells as people write them: thousands separators, and a unit after each number."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from mkc_torch.recording.unit_words import is_unit

_POINTS = r"^\s*[+-]?\d{1,3}(?:\.\d{3})+,\d+\s*$"
_COMMAS = r"^\s*[+-]?\d{1,3}(?:,\d{3})+\.\d+\s*$"
_OTHERS = r"^\s*[+-]?\d{1,3}(?:['’\u00a0\u202f\u2009 ]\d{3})+(?:[.,]\d+)?\s*$"
_GROUPED = {".": r"^\s*[+-]?\d{1,3}(?:\.\d{3})+(?:,\d+)?\s*$", ",": r"^\s*[+-]?\d{1,3}(?:,\d{3})+(?:\.\d+)?\s*$"}
_PLAIN = {".": r"^\s*[+-]?\d*\.(?:\d{1,2}|\d{4,})\s*$", ",": r"^\s*[+-]?\d*,(?:\d{1,2}|\d{4,})\s*$"}
"""Numbers in which the sign is the decimal separator, not a thousands separator."""

_WRITTEN = re.compile("|".join((_POINTS, _COMMAS, _OTHERS)))
_WITH_UNIT = r"^\s*([+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][+-]?\d+)?)\s*([A-Za-zµμ°%][A-Za-zµμ°%/²^0-9]*)\s*$"
_UNIT = re.compile(_WITH_UNIT)


def is_written_number(cell: str) -> bool:
    """Whether a cell is a number with unambiguous thousands separators, or a number with a unit.

    Example:
        >>> [is_written_number(cell) for cell in ("1.234,5", "-33,558.60", "33'558", "24.1 uT", "1,234", "12 apples")]
        [True, True, True, True, False, False]
    """
    if _WRITTEN.fullmatch(cell):
        return True
    found = _UNIT.fullmatch(cell)
    return found is not None and is_unit(found[2])


def without_thousands(series: Sequence[Any]) -> tuple[list[Any], bool]:
    """Remove thousands separators from columns of text; returns the columns, and whether there were any.

    A point is a thousands separator if a cell has points before a comma and no cell has a decimal point; a comma
    likewise. Apostrophes and blanks before three digits are always thousands separators.
    """
    found, done = list(series), False
    for separator, both in ((".", _POINTS), (",", _COMMAS)):
        if any(bool(column.str.contains(both).any()) for column in found) and not any(
            bool(column.str.contains(_PLAIN[separator]).any()) for column in found
        ):
            found = [_without(column, _GROUPED[separator], re.escape(separator)) for column in found]
            done = True
    if any(bool(column.str.contains(_OTHERS).any()) for column in found):
        found = [_without(column, _OTHERS, r"['’\u00a0\u202f\u2009 ]") for column in found]
        done = True
    return found, done


def _without(series: Any, cells: str, separator: str) -> Any:
    has = series.str.contains(cells).fill_null(False)
    return series.str.replace_all(separator, "").zip_with(has, series) if bool(has.any()) else series


def without_units(series: Any) -> tuple[Any, str]:
    """Remove a unit that follows each number of a column; returns the column and the unit, empty if there is none."""
    known = series.drop_nulls()
    known = known.filter(known.str.strip_chars() != "")
    first = _UNIT.fullmatch(known[0]) if len(known) else None
    if first is None or not is_unit(first[2]):
        return series, ""
    parts = known.str.extract_groups(_WITH_UNIT).struct.unnest().get_columns()
    if parts[1].is_null().any() or parts[1].n_unique() > 1:
        return series, ""
    return series.str.extract(_WITH_UNIT, 1), str(first[2])
