"""Inspect a file: its topics and columns, their rates, gaps and units, and the magnetometers that would be read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mkc_torch.recording.choice import choose, sensors_in, which_columns
from mkc_torch.recording.clock import ClockError, clock_of
from mkc_torch.recording.column_names import meaning, split_unit
from mkc_torch.recording.formats import read_topics
from mkc_torch.recording.formats.base import RecordingError, Topic, polars
from mkc_torch.recording.formats.cells import as_numbers
from mkc_torch.recording.formats.text_cells import is_stamp
from mkc_torch.recording.joined_times import with_joined_times
from mkc_torch.recording.recognise import time_column
from mkc_torch.recording.row_sensors import with_row_sensors
from mkc_torch.recording.runs import restarts

_GAP = 10.0  # longest interval that is not a gap, in median intervals


@dataclass(frozen=True)
class ColumnSeen:
    """A column of a file.

    Attributes:
        name: its name in the file.
        kind: "numbers", "whole numbers", "time stamps", "text" or "empty".
        unit: the unit that the file states; empty if it states none.
        looks_like: the canonical name of the column; empty if it is not recognised.
        missing: number of cells without a value.
    """

    name: str
    kind: str
    unit: str
    looks_like: str
    missing: int


@dataclass(frozen=True)
class TopicSeen:
    """A table of a file.

    Attributes:
        name: name of the topic; empty if the file holds a single table.
        rows: number of rows.
        columns: its columns.
        time: name of its time column; empty if there is none.
        seconds: duration of its longest run, in s; None without a time.
        rate: sampling rate by the median interval, in Hz; None without a time.
        gaps: number of intervals longer than ten median intervals.
        longest_gap: in s; 0 without gaps.
        runs: number of runs, at least 1.
        warnings: what was skipped while the table was read.
    """

    name: str
    rows: int
    columns: tuple[ColumnSeen, ...]
    time: str
    seconds: float | None
    rate: float | None
    gaps: int
    longest_gap: float
    runs: int
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class SensorSeen:
    """A magnetometer, and the columns that are read with it.

    Attributes:
        name: its name for ``--sensor``; empty if the file has a single magnetometer.
        topic: name of its topic.
        columns: new name to the name in the file.
        units: units that the file states, by new name.
    """

    name: str
    topic: str
    columns: Mapping[str, str]
    units: Mapping[str, str]


@dataclass(frozen=True)
class FileSeen:
    """The contents of a file.

    Attributes:
        path: path of the file.
        topics: its tables.
        sensors: the recognised magnetometers.
        question: why no magnetometer can be chosen, and the option that names it; empty if the choice is clear.
    """

    path: Path
    topics: tuple[TopicSeen, ...]
    sensors: tuple[SensorSeen, ...]
    question: str


def inspect_file(path: Path) -> FileSeen:
    """Inspect a file.

    Raises:
        RecordingError: the file is of an unknown kind, damaged or empty.
        FileNotFoundError: there is no such file.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "a.csv"
        ...     _ = path.write_text("t,mx,my,mz\\n0,1,2,3\\n0.5,2,3,4\\n")
        ...     seen = inspect_file(path)
        >>> seen.topics[0].rate, dict(seen.sensors[0].columns)
        (2.0, {'mag_x': 'mx', 'mag_y': 'my', 'mag_z': 'mz', 'time': 't'})
    """
    raw = with_row_sensors(read_topics(path))
    topics = with_joined_times(raw)
    sensors, question = [], ""
    try:
        for name in sensors_in(path, topics, {}):
            choice = choose(path, topics, {}, name or None, recognise=True)
            if choice.sensor is None:
                question = which_columns(path, topics)
            else:
                columns = {new: old for new, old in choice.columns.items() if old in topics[choice.topic].table.names}
                sensors.append(SensorSeen(name, topics[choice.topic].name, columns, choice.units))
    except RecordingError as error:
        question = str(error)
    return FileSeen(path, tuple(map(_topic, topics, raw)), tuple(sensors), question)


def _topic(topic: Topic, raw: Topic) -> TopicSeen:
    """Summarise a topic: the columns of the raw file, and the time as it is read."""
    table = topic.table
    columns = tuple(
        _column(raw, name, series) for name, series in zip(raw.table.names, raw.table.series, strict=True) if name
    )
    named = time_column(topic)
    seconds = rate = None
    gaps, longest, runs = 0, 0.0, 1
    if named is not None:
        times = _times(table.series[table.names.index(named[0])], named[1])
        if times is not None:
            begins = [0, *restarts(times)]
            runs = len(begins)
            parts = [times[a:b] for a, b in zip(begins, [*begins[1:], len(times)], strict=True)]
            parts = [np.sort(part[np.isfinite(part)]) for part in parts]
            steps = np.concatenate([np.diff(part) for part in parts])
            steps = steps[steps > 0]
            seconds = max((float(part[-1] - part[0]) for part in parts if len(part)), default=None)
            if len(steps):
                middle = float(np.median(steps))
                rate = float(f"{1.0 / middle:.6g}")
                gaps, longest = int((steps > _GAP * middle).sum()), float(steps.max())
    return TopicSeen(
        topic.name,
        len(table.lines),
        columns,
        "" if named is None else named[0],
        seconds,
        rate,
        gaps,
        longest if gaps else 0.0,
        runs,
        topic.warnings,
    )


def _times(series: Any, unit: str) -> np.ndarray | None:
    try:
        clock = clock_of(series, unit)
    except ClockError:
        return None
    known = np.flatnonzero(np.isfinite(clock.seconds))
    return clock.since(int(known[0])) if len(known) else None


def _column(topic: Topic, name: str, series: Any) -> ColumnSeen:
    known = meaning(name)
    unit = topic.units.get(name) or split_unit(name)[1] or ("" if known is None else known.unit)
    kind, missing = _kind(series)
    return ColumnSeen(name, kind, unit, "" if known is None or kind == "text" else known.column, missing)


def _kind(series: Any) -> tuple[str, int]:
    package = polars()
    if series.dtype.is_temporal():
        return "time stamps", int(series.null_count())
    numbers, bad = as_numbers(series)
    missing = int((numbers.is_null() & ~bad).sum())
    if missing == len(series):
        return "empty", missing
    if bad.any():
        first = str(series[int(bad.arg_max())])
        return "time stamps" if series.dtype == package.String and is_stamp(first) else "text", missing
    values = numbers.drop_nulls().drop_nans()
    whole = bool((values == values.round(0)).all()) and len(values) > 0
    return "whole numbers" if whole else "numbers", missing
