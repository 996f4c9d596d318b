"""Read a file into columns: recognise them, convert their units, and number the runs."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.note import Note
from mkc_torch.recording.choice import ColumnChoice, choose
from mkc_torch.recording.clock import ClockError, TimeAxis, clock_of
from mkc_torch.recording.clock_faults import interleaved, spread
from mkc_torch.recording.conversions import (
    DEFAULT_UNITS,
    Units,
    converted,
    in_units,
    stated_units,
    unit_conversion_warnings,
)
from mkc_torch.recording.formats import read_topics
from mkc_torch.recording.formats.base import RecordingError, Table, Topic, counted, listed
from mkc_torch.recording.formats.cells import as_numbers, missing_warning, numbered, renamed, text_error
from mkc_torch.recording.formats.text_cells import SEPARATORS
from mkc_torch.recording.given_columns import EXPERIMENT
from mkc_torch.recording.join_topics import join_topics
from mkc_torch.recording.joined_times import with_joined_times
from mkc_torch.recording.logged_correction import raw_readings
from mkc_torch.recording.row_sensors import with_row_sensors
from mkc_torch.recording.runs import restarts

REQUIRED_COLUMNS = frozenset({*DEFAULT_UNITS, EXPERIMENT})
"""Required columns: text in any of them is an error."""

_MAG = ("mag_x", "mag_y", "mag_z")

_SHOWN = 5
"""Most runs whose first row a warning lists."""


class LoadedTable(NamedTuple):
    """Columns, units and warnings of a file.

    Attributes:
        columns: name to values, (N,).
        units: units of the columns that are not in the default unit of their name.
        labels: labels of the numbers in ``experiment``.
        warnings: what was recognised, converted, skipped and left out.
        topic: index of the topic that was read.
        sensor: name of the magnetometer if the file holds several, else empty.
        with_stated_unit: columns whose unit the file or the caller states.
    """

    columns: dict[str, Tensor]
    units: dict[str, str]
    labels: dict[str, list[str]]
    warnings: list[str]
    topic: int
    sensor: str
    with_stated_unit: frozenset[str]


def read_file(
    path: Path,
    required: Collection[str],
    *,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    sensor: str | None = None,
    recognise: bool = True,
    topics: Sequence[Topic] | None = None,
) -> LoadedTable:
    """Read a file.

    Args:
        path: the file.
        required: required columns; text in any of them is an error.
        columns, units, sensor, recognise: as in :meth:`mkc_torch.recording.Recording.read`.
        topics: the file's tables if they have been read already.

    Raises:
        RecordingError, MissingColumnError, FileNotFoundError, ImportError: as in
            :meth:`mkc_torch.recording.Recording.read`.
    """
    topics = read_topics(path) if topics is None else topics
    if recognise and not set(_MAG) & set(columns or {}):
        topics = with_row_sensors(topics)
    return load_table(path, topics, required, columns=columns, units=units, sensor=sensor, recognise=recognise)


def load_table(
    path: Path,
    topics: Sequence[Topic],
    required: Collection[str],
    *,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    sensor: str | None = None,
    recognise: bool = True,
    what: str = "file",
) -> LoadedTable:
    """Convert the tables of a file or of a data frame to columns.

    Args:
        path: the name in error messages.
        topics: the tables.
        required, columns, units, sensor, recognise: as in :func:`read_file`.
        what: "file" or "frame", for error messages.

    Raises:
        RecordingError, MissingColumnError: as in :func:`read_file`.
    """
    topics = with_joined_times(topics, (columns or {}).values())
    choice = choose(path, topics, columns or {}, sensor, recognise=recognise)
    topic = topics[choice.topic]
    table = topic.table
    taken, warnings = renamed(table, choice.columns, path, what)
    warnings = [*topic.warnings, *choice.warnings, *warnings]
    stated = stated_units(choice, topic, taken)
    if not recognise:  # only the time is still converted
        stated = {name: unit for name, unit in stated.items() if name == "time"}
    known = in_units(path, taken, stated, units or {})
    values: dict[str, Tensor] = {}
    labels: dict[str, list[str]] = {}
    clock = None
    wanted = {*required, *(columns or {})}
    for name, series in taken.items():
        if name == "time":
            clock = _clock(path, table, series, known)
            if clock is not None:
                values[name] = torch.tensor(clock.seconds)
                continue
        numbers, bad = as_numbers(series)
        if bad.any():
            missing = numbers.is_null() & ~bad
            if name == EXPERIMENT:
                numbers, labels[name] = numbered(series)
            elif name not in wanted and (bad | missing).all():
                warnings.append(Note(f"Column `{name}` holds no numbers and is left out."))
                continue
            else:
                raise text_error(path, table, name, series, int(bad.arg_max()))
        elif numbers.null_count() and (warning := missing_warning(table, name, series)):
            warnings.append(warning)
        values[name] = torch.tensor(
            converted(series, numbers, known.conversions.get(name)).fill_null(math.nan).to_numpy()
        )
    if choice.sensor is not None or set(_MAG) <= set(columns or {}):
        factor = known.conversions["mag_x"].factor if "mag_x" in known.conversions else 1.0
        raw, sentences = raw_readings(topic, choice.columns, values, float(factor), _unit(known))
        values |= raw
        warnings += sentences
    if not values:
        separators = f"separators can be {', '.join(SEPARATORS.values())}"
        raise RecordingError(
            f"{path}: no column holds numbers; {separators if what == 'file' else f'it has {listed(taken)}'}."
        )
    if clock is not None and choice.sensor is not None:
        slow = spread(values["time"].numpy(), torch.stack([values[name] for name in _MAG], -1).numpy())
        if slow is not None:
            values["time"] = torch.tensor(slow[0])
            clock = clock.spread(slow[0])
            sentence = (
                f"Up to {slow[1]} samples share a time stamp; their times were spread evenly up to the next stamp."
            )
            warnings.append(Note(sentence))
    if choice.sensor is not None and (period := interleaved(torch.stack([values[name] for name in _MAG], -1).numpy())):
        warnings.append(
            f"Each row is far from the row before it and close to the row {period} rows before it: rows of {period} "
            "sensors seem to take turns. Write each sensor to its own file, or add a column `sensor` that names the "
            "sensor of each row."
        )
    warnings += _recognised_warnings(choice, taken)
    warnings += unit_conversion_warnings(known, values)
    if choice.sensor is not None and clock is not None and len(topics) > 1:
        more = join_topics(topics, choice.topic, clock, set(values))
        values |= {name: torch.tensor(column) for name, column in more.columns.items()}
        warnings += more.warnings
    warnings += _add_runs(values, table, topic.restarts, clock)
    own = {name: unit for name, unit in known.labels.items() if name in values}
    which = "" if choice.sensor is None else choice.sensor.name
    return LoadedTable(values, own, labels, warnings, choice.topic, which, known.with_stated_unit & set(values))


def _unit(known: Units) -> str:
    return known.labels.get("mag_x", DEFAULT_UNITS["mag_x"])


def _clock(path: Path, table: Table, series: Any, known: Units) -> TimeAxis | None:
    """Parse the time of a table; None if the time has a unit of its own and is read like any other column."""
    if known.labels.get("time"):
        return None
    try:
        return clock_of(series, known.written.get("time", ""))
    except ClockError as error:
        raise text_error(path, table, "time", series, error.row, str(error)) from None


def _recognised_warnings(choice: ColumnChoice, taken: Mapping[str, Any]) -> list[str]:
    """Return the warnings about columns that were recognised under other names."""
    warnings: list[str] = []
    for quantity in dict.fromkeys(name.split("_")[0] for name in choice.found):
        new = [name for name in choice.found if name.split("_")[0] == quantity and name in taken]
        if new:
            old = [choice.found[name] for name in new]
            are = "Columns {} are" if len(new) > 1 else "Column {} is"
            warnings.append(Note(f"{are.format(listed(old))} taken as {listed(new)}."))
    return warnings


def _add_runs(
    values: dict[str, Tensor], table: Table, repeated_headers: Sequence[int], clock: TimeAxis | None
) -> list[str]:
    """Add the column ``experiment`` where the time restarts, and return the warnings.

    Without a time, a run starts at each repeated header. A converted time starts at 0 s in each run.
    """
    warnings: list[str] = []
    if clock is not None and clock.format:
        warnings.append(Note(f"The times are {clock.format}; they were converted to seconds from the first sample."))
    if EXPERIMENT in values:
        _count_from_first(values, clock, [])
        return warnings
    begins = list(repeated_headers) if clock is None else restarts(values["time"].numpy())
    _count_from_first(values, clock, begins)
    if not begins:
        return warnings
    number = np.zeros(len(table.lines))
    number[begins] = 1.0
    values[EXPERIMENT] = torch.tensor(1.0 + number.cumsum())
    rows = ", ".join(f"row {row + 1} ({table.line} {table.lines[row]})" for row in begins[:_SHOWN])
    more = f" and {len(begins) - _SHOWN} more" if len(begins) > _SHOWN else ""
    what = "The time starts again" if clock is not None else "There is no time, and the header is repeated"
    count = counted(len(begins) + 1, "run")
    warnings.append(Note(f"{what} at {rows}{more}: {count}, numbered in an added column, `{EXPERIMENT}`."))
    return warnings


def _count_from_first(values: dict[str, Tensor], clock: TimeAxis | None, begins: Sequence[int]) -> None:
    if clock is None or not clock.format:
        return
    seconds = clock.seconds.copy()
    for begin, end in zip([0, *begins], [*begins, len(seconds)], strict=True):
        known = np.flatnonzero(np.isfinite(clock.seconds[begin:end]))
        if len(known):
            seconds[begin:end] = clock.since(begin + int(known[0]))[begin:end]
    values["time"] = torch.tensor(seconds)
