"""Join a time that is split into two columns: date and time of day, or seconds and fraction."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any

from mkc_torch._support.note import Note
from mkc_torch.recording.column_names import meaning
from mkc_torch.recording.formats.base import Table, Topic, polars
from mkc_torch.recording.formats.cells import as_numbers
from mkc_torch.recording.formats.text_cells import is_date, is_time_of_day

_SECONDS = ("sec", "secs", "second", "seconds", "tv_sec", "s")
_PARTS = {
    "nsec": 9, "nsecs": 9, "nanosec": 9, "nanosecs": 9, "nanosecond": 9, "nanoseconds": 9, "tv_nsec": 9, "ns": 9,
    "usec": 6, "usecs": 6, "microsec": 6, "microsecs": 6, "microseconds": 6, "tv_usec": 6, "us": 6,
    "msec": 3, "msecs": 3, "millisec": 3, "millisecs": 3, "milliseconds": 3, "ms": 3,
}  # fmt: skip
"""Names of fractions of a second, and their number of digits."""

_UNITS = {9: "ns", 6: "us", 3: "ms"}
_NAME = re.compile(r"^(.*?[._/ ]|)([A-Za-z]+|tv_[a-z]+)(\s*[\[(].*[\])])?$")


def with_joined_times(topics: Sequence[Topic], named: Iterable[str] = ()) -> list[Topic]:
    """Join a time of two columns into a column ``time``, or of the stem that both names share.

    This joins a date column and a time-of-day column, and ROS's ``sec`` and ``nanosec``, ``secs`` and ``nsecs``, or
    C's ``tv_sec`` and ``tv_usec`` if all fractions are whole numbers less than a second.

    Args:
        topics: topics of a file.
        named: columns that the caller names, which stay unchanged.

    Example:
        >>> import polars as pl
        >>> table = Table(["sec", "nanosec"], [pl.Series(["7", "8"]), pl.Series(["500000000", "0"])], [2, 3])
        >>> (topic,) = with_joined_times([Topic("", table)])
        >>> topic.table.names, topic.table.series[0].to_list(), topic.units["time"]
        (['time'], [7500000000, 8000000000], 'ns')
    """
    wanted = {name.strip() for name in named}
    found = [_with_date(_with_parts(topic)) for topic in topics]
    return [
        old if wanted & (set(old.table.names) - set(new.table.names)) else new
        for old, new in zip(topics, found, strict=True)
    ]


def _with_parts(topic: Topic) -> Topic:
    table = topic.table
    parsed = [_NAME.match(name.strip().lower()) for name in table.names]
    for i, whole in enumerate(parsed):
        if whole is None or whole[2] not in _SECONDS:
            continue
        for k, part in enumerate(parsed):
            if part is None or part[1] != whole[1] or part[2] not in _PARTS or part[2].startswith("tv_") != (
                whole[2].startswith("tv_")
            ):  # fmt: skip
                continue
            digits = _PARTS[part[2]]
            ticks = _ticks(table.series[i], table.series[k], digits)
            stem = re.sub(r"[._/ ]+$", "", table.names[i].strip()[: len(whole[1])])
            known = meaning(stem) if stem else None
            name = stem if known is not None and known.quantity == "time" else "time"
            if ticks is not None and name not in table.names:
                return _joined(topic, (i, k), name, ticks, _UNITS[digits])
    return topic


def _ticks(whole: Any, part: Any, digits: int) -> Any | None:
    """Combine seconds and their fractions to whole numbers of the small unit; None for other numbers."""
    package = polars()
    found = []
    for series in (whole, part):
        numbers, bad = as_numbers(series)
        if bad.any() or not bool((numbers.is_null() | (numbers == numbers.round(0))).all()):
            return None
        text = series.dtype == package.String
        found.append((series.str.strip_chars() if text else series).cast(package.Int64, strict=False))
        if found[-1].null_count() > numbers.null_count():
            return None
    seconds, parts = found
    if parts.is_null().all() or not bool(parts.is_between(0, 10**digits - 1).all()):
        return None
    largest = seconds.abs().max()
    if largest is None or int(largest) >= 9 * 10 ** (18 - digits):
        return None
    return seconds * 10**digits + parts


def _with_date(topic: Topic) -> Topic:
    """Join the only column of dates and the only column of times of day, recognised by their cells."""
    table = topic.table
    if any(series.dtype.is_temporal() for series in table.series):
        return topic
    dates = [i for i, series in enumerate(table.series) if _holds(series, is_date)]
    days = [i for i, series in enumerate(table.series) if _holds(series, is_time_of_day)]
    if len(dates) != 1 or len(days) != 1:
        return topic
    date, day = dates[0], days[0]
    name = "time" if "time" not in table.names or table.names[day] == "time" else table.names[day]
    joined = table.series[date].str.strip_chars() + " " + table.series[day].str.strip_chars()
    return _joined(topic, (date, day), name, joined, "")


def _holds(series: Any, matches: Any) -> bool:
    if series.dtype != polars().String:
        return False
    known = series.drop_nulls()
    known = known.filter(known.str.strip_chars() != "")
    return len(known) > 0 and all(matches(known[row]) for row in {0, len(known) // 2, len(known) - 1})


def _joined(topic: Topic, places: tuple[int, int], name: str, series: Any, unit: str) -> Topic:
    table = topic.table
    joined_columns = f"Columns `{table.names[places[0]]}` and `{table.names[places[1]]}`"
    note = Note(f"{joined_columns} are joined into a single time.")
    kept = [i for i in range(len(table.names)) if i not in places]
    names = [name, *(table.names[i] for i in kept)]
    units = {key: own for key, own in topic.units.items() if key in names and key != name}
    joined = Table(names, [series, *(table.series[i] for i in kept)], table.lines, table.line)
    return topic._replace(table=joined, units=units | ({name: unit} if unit else {}), warnings=(*topic.warnings, note))
