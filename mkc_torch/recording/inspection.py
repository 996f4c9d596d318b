"""What is in a file: its topics and columns, their rates, gaps and units, and what would be read of it."""

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

__all__ = ["ColumnSeen", "FileSeen", "SensorSeen", "TopicSeen", "inspect_file"]

_GAP = 10.0  # in median intervals


@dataclass(frozen=True)
class ColumnSeen:
    """A column as it stands in a file.

    Attributes:
        name: in the file.
        kind: numbers, whole numbers, time stamps, text, or empty.
        unit: that the file says; empty where it says none.
        looks_like: the name that a recording has for it; empty where it is not known.
        missing: how many of its cells hold no value.
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
        name: empty where a file holds one alone.
        rows: how many.
        columns: of it.
        time: its column of time; empty where there is none.
        seconds: from the first to the last time of its longest run, in s; None without a time.
        rate: samples a second, by the median interval, in Hz; None without a time.
        gaps: intervals of more than ten median ones.
        longest_gap: in s; 0 without any.
        runs: how often its time starts, at least 1.
        warnings: sentences about what was skipped while it was read.
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
    """A magnetometer, and what is read with it.

    Attributes:
        name: by which ``--sensor`` takes it; empty where there is one alone.
        topic: that it is in.
        columns: for each name that a column gets, the name it has in the file.
        units: that the file says, by the new names.
    """

    name: str
    topic: str
    columns: Mapping[str, str]
    units: Mapping[str, str]


@dataclass(frozen=True)
class FileSeen:
    """What is in a file.

    Attributes:
        path: of it.
        topics: its tables.
        sensors: the magnetometers that are recognised.
        question: why none is taken without being named, and the option that does it; empty where there is no question.
    """

    path: Path
    topics: tuple[TopicSeen, ...]
    sensors: tuple[SensorSeen, ...]
    question: str


def inspect_file(path: Path) -> FileSeen:
    """Look at a file.

    Raises:
        RecordingError: no file of a known kind, or a damaged or empty one.
        FileNotFoundError: no such file.

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
    """What is seen of a topic: its columns as they stand in the file, the time as it is read."""
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
    said = meaning(name)
    unit = topic.units.get(name) or split_unit(name)[1] or ("" if said is None else said.unit)
    kind, missing = _kind(series)
    return ColumnSeen(name, kind, unit, "" if said is None or kind == "text" else said.column, missing)


def _kind(series: Any) -> tuple[str, int]:
    package = polars()
    if series.dtype.is_temporal():
        return "time stamps", int(series.null_count())
    numbers, bad = as_numbers(series)
    none = int((numbers.is_null() & ~bad).sum())
    if none == len(series):
        return "empty", none
    if bad.any():
        first = str(series[int(bad.arg_max())])
        return "time stamps" if series.dtype == package.String and is_stamp(first) else "text", none
    values = numbers.drop_nulls().drop_nans()
    whole = bool((values == values.round(0)).all()) and len(values) > 0
    return "whole numbers" if whole else "numbers", none
