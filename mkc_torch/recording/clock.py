"""Parse the times of a file, stamps or numbers of any unit, into seconds; differences are taken before rounding."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import numpy as np

from mkc_torch.recording.clock_faults import turned_over
from mkc_torch.recording.formats.base import MISSING, polars
from mkc_torch.recording.formats.text_cells import is_stamp
from mkc_torch.recording.stamps import as_iso
from mkc_torch.recording.unit_words import conversion

_NANO = 10**9
"""Nanoseconds in a second."""

_DAY = 86_400
"""Seconds in a day."""

_EPOCH = (10**9, 41 * 10**8)
"""Range of a count since 1970, September 2001 to 2099, in s; only one unit puts a count in this range."""

_INTERVALS = (1e-6, 3600.0)
"""Range of a sensor's median sampling interval, in s; a wrong unit of a count since 1970 lies outside."""

_FEW = 10
"""Fewest samples from which a column of days is recognised."""

_DAYS = ((36_526, 73_051), (730_486, 767_011))
"""Ranges of day numbers of this century: since 1900 (spreadsheets) and since the year 0 (MATLAB)."""

_DAY_STEPS = (1e-8, 1e-5)
"""Range of the median sampling interval of a column of days, in days."""

_LONG = {"min": 60.0, "h": 3600.0, "days": 86_400.0}
"""Seconds in units longer than a second."""

_ISO = (
    r"^(\d{4})-?(\d\d)-?(\d\d)(?:[T ](\d\d):?(\d\d)(?::?(\d\d)(?:[.,](\d+))?)?\s*"
    r"(?:(Z|UTC)|([+-])(\d\d):?(\d\d)?)?)?$"
)
_PLAIN = re.compile(r"\d{4}-?\d\d-?\d\d|\d{1,2}:\d\d")
_MINUTES = re.compile(r"\d{1,3}:\d\d[.,]\d+")
_HALF = re.compile(r"[AaPp]\.?[Mm]\.?$")
_OF_DAY = r"^(\d{1,2}):(\d\d)(?::(\d\d)(?:[.,](\d+))?)?$"


class ClockError(ValueError):
    """A cell does not hold a time; ``row`` is its row, counted from 0."""

    def __init__(self, row: int, advice: str) -> None:
        super().__init__(advice)
        self.row = row


class TimeAxis(NamedTuple):
    """The times of a table.

    Attributes:
        ticks: times in whole nanoseconds, (N,); None if the times are not whole nanoseconds.
        seconds: times in s, (N,); NaN where a time is missing.
        format: how the times were read, for a warning; empty if the file holds plain seconds.
    """

    ticks: np.ndarray | None
    seconds: np.ndarray
    format: str

    def spread(self, seconds: np.ndarray) -> TimeAxis:
        """Replace the times by ``seconds``, (N,), which differ from them by less than a step of the clock."""
        if self.ticks is None:
            return self._replace(seconds=seconds)
        added = np.nan_to_num(seconds - self.seconds)
        return self._replace(ticks=self.ticks + np.rint(added * _NANO).astype(np.int64), seconds=seconds)

    def since(self, row: int) -> np.ndarray:
        """Seconds since the time of a row, (N,)."""
        if self.ticks is None:
            return self.seconds - self.seconds[row]
        passed = (self.ticks - self.ticks[row]) / _NANO
        return np.where(np.isnan(self.seconds), np.nan, passed)


def clock_of(series: Any, unit: str = "") -> TimeAxis:
    """Parse a column of times: ISO 8601 stamps, times of the day, counts since 1970, or numbers with a unit.

    A count since 1970 is recognised by its size: only one unit puts it between 2001 and 2099 with sampling intervals
    of a microsecond to an hour. Other numbers without a unit are taken as seconds.

    Args:
        series: a polars series.
        unit: unit of its numbers if known: s, ms, µs or ns.

    Raises:
        ClockError: a cell does not hold a time, or only some of the stamps have a time zone.

    Example:
        >>> import polars as pl
        >>> clock_of(pl.Series(["2024-05-03T10:00:00Z", "2024-05-03T12:00:00.25+02:00"])).since(0)
        array([0.  , 0.25])
    """
    package = polars()
    if series.dtype.is_temporal():
        return _of_type(series)
    if series.dtype == package.String:
        text = series.str.strip_chars()
        text = text.set(text.str.to_lowercase().is_in(MISSING).fill_null(False), None)
        first = next((cell for cell in text if cell is not None), "")
        if not is_stamp(first):
            return _of_numbers(text, unit)
        minutes = bool(_MINUTES.fullmatch(first))
        iso = as_iso(text.to_list()) if minutes or not _PLAIN.match(first) or _HALF.search(first) else None
        return _of_stamps(text if iso is None else package.Series(iso, dtype=package.String), minutes)
    return _of_numbers(series, unit)


def _of_type(series: Any) -> TimeAxis:
    package = polars()
    if series.dtype == package.Date:
        series = series.cast(package.Datetime("ns"))
    if series.dtype == package.Time:
        ticks = series.cast(package.Int64)
    else:
        same = package.Duration if series.dtype == package.Duration else package.Datetime
        ticks = series.cast(same("ns")).cast(package.Int64)
    return _exact(ticks, "stamps")


def _exact(ticks: Any, format_name: str) -> TimeAxis:
    none = ticks.is_null().to_numpy()
    whole = ticks.fill_null(0).to_numpy().astype(np.int64)
    return TimeAxis(whole, np.where(none, np.nan, whole / _NANO), format_name)


def _of_stamps(text: Any, minutes: bool) -> TimeAxis:
    package = polars()
    if ":" in next(cell for cell in text if cell is not None)[:3]:
        return _of_days(text, 3600 if minutes else _DAY)
    parts = text.str.extract_groups(_ISO).struct.unnest()
    year, month, day, hour, minute, second, digits, utc, sign, off_hour, off_minute = parts.get_columns()
    date = package.select(package.date(*(part.cast(package.Int32) for part in (year, month, day)))).to_series() if (
        _dates_exist(year, month, day)
    ) else (year + "-" + month + "-" + day).str.to_date("%Y-%m-%d", strict=False)  # fmt: skip
    bad = text.is_not_null() & date.is_null()
    clock = [_whole(hour), _whole(minute), _whole(second)]
    bad = bad | (clock[0] > 24) | (clock[1] > 59) | (clock[2] > 60)
    if bad.any():
        raise ClockError(int(bad.arg_max()), "write times as seconds, or as 2024-05-03T10:00:00.25")
    zoned = (utc.is_not_null() | sign.is_not_null()) & text.is_not_null()
    if zoned.any() and not (zoned | text.is_null()).all():
        unlike = zoned != zoned[int(text.is_not_null().arg_max())]
        raise ClockError(
            int((unlike & text.is_not_null()).arg_max()), "write all stamps with a zone, or all without a zone"
        )
    offset = (_whole(off_hour) * 3600 + _whole(off_minute) * 60) * (1 - 2 * (sign == "-").fill_null(False).cast(int))
    seconds = date.cast(package.Int64) * _DAY + clock[0] * 3600 + clock[1] * 60 + clock[2] - offset
    return _exact(seconds * _NANO + _fraction(digits), "ISO 8601 stamps")


def _dates_exist(year: Any, month: Any, day: Any) -> bool:
    """Whether all dates surely exist (day 28 at most), so that they can be converted at once."""
    months, days = _whole(month), _whole(day)
    return bool(year.is_not_null().all() and months.is_between(1, 12).all() and days.is_between(1, 28).all())


def _of_days(text: Any, turn: int) -> TimeAxis:
    """Parse times of the day, or of the hour; a fall by more than half a turn is midnight, or the next hour."""
    hour, minute, second, digits = text.str.extract_groups(_OF_DAY).struct.unnest().get_columns()
    bad = text.is_not_null() & (hour.is_null() | (_whole(hour) > 24) | (_whole(minute) > 59) | (_whole(second) > 60))
    if bad.any():
        raise ClockError(int(bad.arg_max()), "write times as seconds, or as 10:00:00.25")
    package = polars()
    ticks = (_whole(hour) * 3600 + _whole(minute) * 60 + _whole(second)) * _NANO + _fraction(digits)
    ticks = ticks.set(text.is_null(), None)
    known = ticks.drop_nulls().to_numpy()
    nights = np.concatenate([[0], np.cumsum(np.diff(known) < -turn * _NANO // 2)]) if len(known) else known
    whole = ticks.to_numpy().copy() if not ticks.null_count() else ticks.fill_null(0).to_numpy().copy()
    whole[ticks.is_not_null().to_numpy()] += (nights * turn * _NANO).astype(np.int64)
    return _exact(package.Series(whole).set(ticks.is_null(), None), "times of the day" if turn == _DAY else "minutes")


def _whole(digits: Any) -> Any:
    return digits.cast(polars().Int64).fill_null(0)


def _fraction(digits: Any) -> Any:
    """Convert the digits after the decimal point to nanoseconds."""
    return _whole(digits.fill_null("0").str.slice(0, 9).str.pad_end(9, "0"))


def _of_numbers(series: Any, unit: str) -> TimeAxis:
    clock, size = _counted(series, unit)
    raw = clock.seconds / size if clock.ticks is None else clock.ticks / (size * _NANO)
    added, end = turned_over(np.where(np.isnan(clock.seconds), np.nan, raw), size)
    if not end:
        return clock
    ticks = None if clock.ticks is None else clock.ticks + np.rint(added * size * _NANO).astype(np.int64)
    format_name = f"{clock.format or 's'}, unwrapped where the counter turned over at {end}"
    return TimeAxis(ticks, clock.seconds + added * size, format_name)


def _counted(series: Any, unit: str) -> tuple[TimeAxis, float]:
    """The times of a column of numbers, and the size of its unit in s."""
    package = polars()
    values = series.cast(package.Float64, strict=False)
    if series.dtype == package.String and (bad := series.is_not_null() & values.is_null()).any():
        raise ClockError(int(bad.arg_max()), "times are numbers, in seconds, or stamps such as 2024-05-03T10:00:00.25")
    seconds = values.fill_null(np.nan).to_numpy()
    epoch = _epoch_unit(seconds)
    known = conversion("time", unit)
    if known is None and epoch is None:
        if _are_days(seconds):
            return TimeAxis(None, seconds * _DAY, "days, as spreadsheets count them"), float(_DAY)
        return TimeAxis(None, seconds, ""), 1.0
    if known is not None and known.unit == "s" and epoch != "s":
        return TimeAxis(None, seconds, ""), 1.0
    if known is not None and known.unit in _LONG:
        return TimeAxis(None, seconds * _LONG[known.unit], known.unit), _LONG[known.unit]
    name = known.unit if known is not None else str(epoch)
    format_name = f"{name} since 1970" if epoch == name else name
    digits = {"s": 9, "ms": 6, "µs": 3, "ns": 0}[name]
    exact = _ticks(series, digits)
    if exact is not None:
        return _exact(exact, format_name), 10.0**digits / _NANO
    return TimeAxis(None, seconds * 10.0**digits / _NANO, format_name), 10.0**digits / _NANO


def _are_days(values: np.ndarray) -> bool:
    """Whether numbers are days of this century since 1900 (spreadsheets) or since the year 0 (MATLAB).

    Read as seconds, the samples would be less than ten microseconds apart.
    """
    finite = values[np.isfinite(values)]
    if len(finite) < _FEW:
        return False
    first, interval = float(finite[0]), float(np.median(np.abs(np.diff(finite))))
    return any(low <= first < high for low, high in _DAYS) and _DAY_STEPS[0] <= interval <= _DAY_STEPS[1]


def _epoch_unit(values: np.ndarray) -> str | None:
    """The unit of a count since 1970; None if the numbers are not such a count."""
    finite = values[np.isfinite(values)]
    if len(finite) < 2:
        return None
    first, interval = float(finite[0]), float(np.median(np.abs(np.diff(finite))))
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6), ("ns", 1e-9)):
        if _EPOCH[0] <= first * size < _EPOCH[1] and _INTERVALS[0] <= interval * size <= _INTERVALS[1]:
            return unit
    return None


def _ticks(series: Any, digits: int) -> Any | None:
    """Convert numbers in units of 10^digits ns to whole nanoseconds; None if a number is not a whole nanosecond."""
    package = polars()
    if series.dtype.is_integer():
        whole = series.cast(package.Int64)
        return whole * 10**digits if _fits(whole, digits) else None
    if series.dtype != package.String:
        return None
    plain = series.str.extract_groups(r"^([+-]?\d{1,19})(?:\.(\d*?)0*)?$").struct.unnest().get_columns()
    if (plain[0].is_null() & series.is_not_null()).any() or bool((plain[1].str.len_bytes() > digits).any()):
        return None
    whole = plain[0].cast(package.Int64, strict=False)
    if whole.null_count() > plain[0].null_count() or not _fits(whole, digits):
        return None
    after = _whole(plain[1].fill_null("").str.slice(0, digits).str.pad_end(digits, "0")) if digits else 0
    sign = 1 - 2 * plain[0].str.starts_with("-").cast(package.Int64)
    return whole * 10**digits + sign * after


def _fits(whole: Any, digits: int) -> bool:
    largest = whole.abs().max()
    return largest is None or int(largest) < 9 * 10 ** (18 - digits)
