"""Convert dates and times, as people and spreadsheets write them, to ISO 8601."""

from __future__ import annotations

import re
from collections.abc import Sequence

_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_YEAR_FIRST = re.compile(r"(\d{4})[/.](\d{1,2})[/.](\d{1,2})(?:[T ]+(.*))?")
_YEAR_LAST = re.compile(r"(\d{1,2})([./])(\d{1,2})\2(\d{4})(?:,?[T ]+(.*))?")
_NAMED = re.compile(r"(\d{1,2})[- ]([A-Za-z]{3})[- ](\d{4})(?:[T ]+(.*))?")
_HALF = re.compile(r"(\d{1,2})(:.*?)\s*([AaPp])\.?[Mm]\.?")
_MINUTES = re.compile(r"\d{1,3}:\d\d[.,]\d+")
_ISO = re.compile(r"\d{4}-?\d\d-?\d\d([T ].*)?|\d{1,2}:\d\d(:.*)?")


def as_iso(cells: Sequence[str | None]) -> list[str | None] | None:
    """Convert stamps to ISO 8601; other cells stay unchanged. None if nothing has to be converted.

    Formats: ``2024/05/03``, ``03.05.2024``, ``5/3/2024``, ``03-May-2024``, hours with AM and PM, and minutes with
    seconds, ``59:58.5``, as spreadsheets write truncated times. In ``5/3/2024`` the day or the month comes first,
    whichever makes all cells valid dates; if both do, whichever gives the shorter time span. If all cells have the
    same date, the order does not change time differences.

    Example:
        >>> as_iso(["03.05.2024 9:00:00", "3.5.2024 10:00:00"])
        ['2024-05-03 09:00:00', '2024-05-03 10:00:00']
        >>> as_iso(["5/31/2024 11:59:59 PM", "6/1/2024 12:00:01 AM"])
        ['2024-05-31 23:59:59', '2024-06-01 00:00:01']
        >>> as_iso(["2024-05-03T10:00:00"]) is None
        True
    """
    known = [cell for cell in cells if cell]
    if not known or all(_ISO.fullmatch(cell) and not _HALF.fullmatch(cell) for cell in known):
        return None
    first_is_day = _first_is_day(known)
    return [None if cell is None else _stamp_as_iso(cell, first_is_day) for cell in cells]


def _stamp_as_iso(cell: str, first_is_day: bool) -> str:
    if found := _YEAR_FIRST.fullmatch(cell):
        year, month, day, clock = found.groups()
    elif found := _NAMED.fullmatch(cell):
        day, word, year, clock = found.groups()
        if word.lower() not in _MONTHS:
            return cell
        month = str(_MONTHS.index(word.lower()) + 1)
    elif found := _YEAR_LAST.fullmatch(cell):
        day, separator, month, year, clock = found.groups()
        if separator == "/" and not first_is_day:
            day, month = month, day
    elif _MINUTES.fullmatch(cell):
        minutes, _, seconds = cell.partition(":")
        return f"{int(minutes) // 60:02d}:{int(minutes) % 60:02d}:{seconds}"
    else:
        date, blank, clock = cell.rpartition(" ") if not _HALF.search(cell) else cell.partition(" ")
        if _HALF.fullmatch(cell):
            date, blank, clock = "", "", cell
        return f"{date}{blank}{_clock(clock)}"
    date = f"{year}-{int(month):02d}-{int(day):02d}"
    return f"{date} {_clock(clock)}" if clock else date


def _clock(text: str) -> str:
    """A time of the day with a two-digit hour from 0 to 23."""
    half = _HALF.fullmatch(text.strip())
    if half is None:
        return re.sub(r"^(\d):", r"0\1:", text.strip())
    hour = int(half[1]) % 12 + (12 if half[3].lower() == "p" else 0)
    return f"{hour:02d}{half[2]}" if 1 <= int(half[1]) <= 12 else text


def _first_is_day(cells: Sequence[str]) -> bool:
    dates = sorted(
        {found.group(1, 3, 4) for cell in cells if (found := _YEAR_LAST.fullmatch(cell)) and found[2] == "/"}
    )
    pairs = [(int(a), int(b), int(year)) for a, b, year in dates]
    if any(a > 12 for a, _, _ in pairs):
        return True
    if any(b > 12 for _, b, _ in pairs):
        return False
    day_first = [year * 372 + b * 31 + a for a, b, year in pairs]
    month_first = [year * 372 + a * 31 + b for a, b, year in pairs]
    return bool(pairs) and max(day_first) - min(day_first) < max(month_first) - min(month_first)
