"""Numbers in cells as people write them: signs between thousands, and a unit behind each of a column."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from mkc_torch.recording.unit_words import is_unit

__all__ = ["is_written_number", "without_thousands", "without_units"]

_POINTS = r"^\s*[+-]?\d{1,3}(?:\.\d{3})+,\d+\s*$"
_COMMAS = r"^\s*[+-]?\d{1,3}(?:,\d{3})+\.\d+\s*$"
_OTHERS = r"^\s*[+-]?\d{1,3}(?:['’\u00a0\u202f\u2009 ]\d{3})+(?:[.,]\d+)?\s*$"
_GROUPED = {".": r"^\s*[+-]?\d{1,3}(?:\.\d{3})+(?:,\d+)?\s*$", ",": r"^\s*[+-]?\d{1,3}(?:,\d{3})+(?:\.\d+)?\s*$"}
_PLAIN = {".": r"^\s*[+-]?\d*\.(?:\d{1,2}|\d{4,})\s*$", ",": r"^\s*[+-]?\d*,(?:\d{1,2}|\d{4,})\s*$"}
"""What a sign is no sign between thousands in."""

_WRITTEN = re.compile("|".join((_POINTS, _COMMAS, _OTHERS)))
_WITH_UNIT = r"^\s*([+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][+-]?\d+)?)\s*([A-Za-zµμ°%][A-Za-zµμ°%/²^0-9]*)\s*$"
_UNIT = re.compile(_WITH_UNIT)


def is_written_number(cell: str) -> bool:
    """Whether a cell is a number with signs between thousands that nothing else can be, or one with its unit.

    Example:
        >>> [is_written_number(cell) for cell in ("1.234,5", "-33,558.60", "33'558", "24.1 uT", "1,234", "12 apples")]
        [True, True, True, True, False, False]
    """
    if _WRITTEN.fullmatch(cell):
        return True
    found = _UNIT.fullmatch(cell)
    return found is not None and is_unit(found[2])


def without_thousands(series: Sequence[Any]) -> tuple[list[Any], bool]:
    """Columns of text without the signs between thousands, and whether there were any.

    A point is one where a cell of the file has points before a comma, and none has a point that ends a number
    otherwise; a comma likewise. Apostrophes and blanks before three digits are nothing else.
    """
    found, done = list(series), False
    for sign, both in ((".", _POINTS), (",", _COMMAS)):
        if any(bool(one.str.contains(both).any()) for one in found) and not any(
            bool(one.str.contains(_PLAIN[sign]).any()) for one in found
        ):
            found = [_without(one, _GROUPED[sign], re.escape(sign)) for one in found]
            done = True
    if any(bool(one.str.contains(_OTHERS).any()) for one in found):
        found = [_without(one, _OTHERS, r"['’\u00a0\u202f\u2009 ]") for one in found]
        done = True
    return found, done


def _without(series: Any, cells: str, sign: str) -> Any:
    has = series.str.contains(cells).fill_null(False)
    return series.str.replace_all(sign, "").zip_with(has, series) if bool(has.any()) else series


def without_units(series: Any) -> tuple[Any, str]:
    """A column without the unit that stands behind each of its numbers, and the unit; empty where none does."""
    known = series.drop_nulls()
    known = known.filter(known.str.strip_chars() != "")
    first = _UNIT.fullmatch(known[0]) if len(known) else None
    if first is None or not is_unit(first[2]):
        return series, ""
    parts = known.str.extract_groups(_WITH_UNIT).struct.unnest().get_columns()
    if parts[1].is_null().any() or parts[1].n_unique() > 1:
        return series, ""
    return series.str.extract(_WITH_UNIT, 1), str(first[2])
