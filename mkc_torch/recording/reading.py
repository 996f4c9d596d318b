"""A file as the columns of a recording: recognised, in this library's units, with its runs told apart."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mkc_torch.recording.choice import ColumnChoice, choose
from mkc_torch.recording.clock import ClockError, TimeAxis, clock_of
from mkc_torch.recording.clock_faults import interleaved, spread
from mkc_torch.recording.conversions import DEFAULT_UNITS, Units, converted, in_units, said_units, units_told
from mkc_torch.recording.formats import read_topics
from mkc_torch.recording.formats.base import RecordingError, Table, Topic, counted, listed
from mkc_torch.recording.formats.cells import as_numbers, missing_warning, numbered, renamed, text_error
from mkc_torch.recording.formats.text_cells import SEPARATORS
from mkc_torch.recording.given_columns import EXPERIMENT
from mkc_torch.recording.join_topics import join_topics
from mkc_torch.recording.joined_times import with_joined_times
from mkc_torch.recording.row_sensors import with_row_sensors
from mkc_torch.recording.runs import restarts

__all__ = ["ASKED", "LoadedTable", "read_file", "reading_of"]

ASKED = frozenset({*DEFAULT_UNITS, EXPERIMENT})
"""Columns that are wanted wherever they are, so that text in them is an error."""

_MAG = ("mag_x", "mag_y", "mag_z")

_SHOWN = 5
"""Runs whose first rows a sentence names."""


class LoadedTable(NamedTuple):
    """What a file holds of a recording.

    Attributes:
        columns: name to values, (N,).
        units: of columns, where they differ from those that their names have.
        labels: what the numbers of ``experiment`` stand for.
        warnings: sentences about what was recognised, converted, skipped and left out.
        topic: number of the topic that was read.
        sensor: name of the magnetometer, where the file has several.
        said: columns whose unit the file or the caller says.
    """

    columns: dict[str, Tensor]
    units: dict[str, str]
    labels: dict[str, list[str]]
    warnings: list[str]
    topic: int
    sensor: str
    said: frozenset[str]


def read_file(
    path: Path,
    asked: Collection[str],
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
        asked: columns that are wanted wherever they are, so that text in them is an error.
        columns, units, sensor, recognise: as :meth:`mkc_torch.recording.Recording.read` takes them.
        topics: the file's tables, where they have been read already.

    Raises:
        RecordingError, MissingColumnError, FileNotFoundError, ImportError: as there.
    """
    topics = read_topics(path) if topics is None else topics
    if recognise and not set(_MAG) & set(columns or {}):
        topics = with_row_sensors(topics)
    return reading_of(path, topics, asked, columns=columns, units=units, sensor=sensor, recognise=recognise)


def reading_of(
    path: Path,
    topics: Sequence[Topic],
    asked: Collection[str],
    *,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    sensor: str | None = None,
    recognise: bool = True,
    what: str = "file",
) -> LoadedTable:
    """Read the tables of a file, or of a data frame.

    Args:
        path: what they are called in messages.
        topics: the tables.
        asked, columns, units, sensor, recognise: as :func:`read_file` takes them.
        what: file or frame.

    Raises:
        RecordingError, MissingColumnError: as :func:`read_file`.
    """
    topics = with_joined_times(topics, (columns or {}).values())
    choice = choose(path, topics, columns or {}, sensor, recognise=recognise)
    topic = topics[choice.topic]
    table = topic.table
    taken, warnings = renamed(table, choice.columns, path, what)
    warnings = [*topic.warnings, *choice.warnings, *warnings]
    said = said_units(choice, topic, taken)
    if not recognise:  # the caller knows what the columns are; a clock's unit is none of its business
        said = {name: unit for name, unit in said.items() if name == "time"}
    known = in_units(path, taken, said, units or {})
    values: dict[str, Tensor] = {}
    labels: dict[str, list[str]] = {}
    clock = None
    wanted = {*asked, *(columns or {})}
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
                warnings.append(f"Column `{name}` holds no numbers and is left out.")
                continue
            else:
                raise text_error(path, table, name, series, int(bad.arg_max()))
        elif told := missing_warning(table, name, series):
            warnings.append(told)
        values[name] = torch.tensor(
            converted(series, numbers, known.conversions.get(name)).fill_null(math.nan).to_numpy()
        )
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
            warnings.append(
                f"The clock stands still over up to {slow[1]} samples; samples of one time were spread evenly up to "
                "the next."
            )
    if choice.sensor is not None and (turns := interleaved(torch.stack([values[name] for name in _MAG], -1).numpy())):
        warnings.append(
            f"Every row is far from the one before and near to that {turns} rows before: rows of {turns} sensors "
            "seem to take turns. Write them into files of their own, or say by a column `sensor` which a row is of."
        )
    warnings += _taken_told(choice, taken)
    warnings += units_told(known, values)
    if choice.sensor is not None and clock is not None and len(topics) > 1:
        more = join_topics(topics, choice.topic, clock, set(values))
        values |= {name: torch.tensor(column) for name, column in more.columns.items()}
        warnings += more.warnings
    warnings += _add_runs(values, table, topic.restarts, clock)
    own = {name: unit for name, unit in known.labels.items() if name in values}
    which = "" if choice.sensor is None else choice.sensor.name
    return LoadedTable(values, own, labels, warnings, choice.topic, which, known.said & set(values))


def _clock(path: Path, table: Table, series: Any, known: Units) -> TimeAxis | None:
    """The time of a table; None where it is to be read as any other column."""
    if known.labels.get("time"):
        return None
    try:
        return clock_of(series, known.written.get("time", ""))
    except ClockError as error:
        raise text_error(path, table, "time", series, error.row, str(error)) from None


def _taken_told(choice: ColumnChoice, taken: Mapping[str, Any]) -> list[str]:
    """Sentences about columns that were recognised under other names."""
    told = []
    for quantity in dict.fromkeys(name.split("_")[0] for name in choice.found):
        new = [name for name in choice.found if name.split("_")[0] == quantity and name in taken]
        if new:
            old = [choice.found[name] for name in new]
            are = "Columns {} are" if len(new) > 1 else "Column {} is"
            told.append(f"{are.format(listed(old))} taken as {listed(new)}.")
    return told


def _add_runs(values: dict[str, Tensor], table: Table, again: Sequence[int], clock: TimeAxis | None) -> list[str]:
    """Number the runs where the time starts again, or the header stands again where there is no time; and tell it.

    A time that was converted is counted from the first sample of its run.
    """
    told = [] if clock is None or not clock.told else [_clock_told(clock)]
    if EXPERIMENT in values:
        _count_from_first(values, clock, [])
        return told
    begins = list(again) if clock is None else restarts(values["time"].numpy())
    _count_from_first(values, clock, begins)
    if not begins:
        return told
    number = np.zeros(len(table.lines))
    number[begins] = 1.0
    values[EXPERIMENT] = torch.tensor(1.0 + number.cumsum())
    rows = ", ".join(f"row {row + 1} ({table.line} {table.lines[row]})" for row in begins[:_SHOWN])
    more = f" and {len(begins) - _SHOWN} more" if len(begins) > _SHOWN else ""
    what = "The time starts again" if clock is not None else "The header stands again, and there is no time,"
    told.append(
        f"{what} at {rows}{more}: {counted(len(begins) + 1, 'run')}, which the column `{EXPERIMENT}` tells apart."
    )
    return told


def _clock_told(clock: TimeAxis) -> str:
    return f"The times are {clock.told}; they are counted in seconds from the first sample on."


def _count_from_first(values: dict[str, Tensor], clock: TimeAxis | None, begins: Sequence[int]) -> None:
    if clock is None or not clock.told:
        return
    seconds = clock.seconds.copy()
    for begin, end in zip([0, *begins], [*begins, len(seconds)], strict=True):
        known = np.flatnonzero(np.isfinite(clock.seconds[begin:end]))
        if len(known):
            seconds[begin:end] = clock.since(begin + int(known[0]))[begin:end]
    values["time"] = torch.tensor(seconds)
