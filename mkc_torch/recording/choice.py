"""Which topic of a file is read, and which of its columns as what: as the caller says, else as recognised."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from mkc_torch.recording.column_names import meaning
from mkc_torch.recording.formats.base import MissingColumnError, RecordingError, Topic, listed
from mkc_torch.recording.recognise import RecognisedColumns, SensorColumns, candidates, recognised, time_column

__all__ = ["ColumnChoice", "choose", "columns_option", "sensors_in", "which_columns"]

_MAG = ("mag_x", "mag_y", "mag_z")


class ColumnChoice(NamedTuple):
    """What is read of a file.

    Attributes:
        topic: number of the topic.
        columns: for each name that a column is to have, the name it has in the topic.
        found: those of them that were recognised and have another name there.
        units: that were recognised with them, by the new names.
        sensor: the magnetometer; None where none is read as one.
        warnings: sentences about what was left out.
    """

    topic: int
    columns: dict[str, str]
    found: dict[str, str]
    units: dict[str, str]
    sensor: SensorColumns | None
    warnings: tuple[str, ...]


def choose(
    path: Path, topics: Sequence[Topic], columns: Mapping[str, str], sensor: str | None, *, recognise: bool
) -> ColumnChoice:
    """Choose.

    Args:
        path: of the file, for messages.
        topics: in it.
        columns: the caller's: new name to the name in the file; in a file of several topics ``topic.column`` too.
        sensor: name of the magnetometer, where the file has several.
        recognise: whether the names of columns say what they are.

    Raises:
        RecordingError: several magnetometers and none is named, or none of that name.
        MissingColumnError: ``columns`` names a column that no topic has.
    """
    if set(columns) & set(_MAG) or not recognise:
        if sensor is not None:
            raise RecordingError(f"{path}: name the magnetometer's columns, or a sensor, but not both.")
        return _as_said(path, topics, columns)
    found = recognised(topics, path.stem)
    chosen = _chosen(path, topics, found, sensor)
    if chosen is None:
        return _as_said(path, topics, columns)
    topic = topics[chosen.topic]
    said = {new: _local(old, topic) for new, old in columns.items()}
    mine = {
        new: old
        for new, old in chosen.columns.items()
        if new not in said
        and old not in said.values()
        and (new == old or new in _MAG or new not in topic.table.names)  # the sensor that was chosen wins
    }
    return ColumnChoice(
        chosen.topic,
        said | mine,
        {new: old for new, old in mine.items() if new != old},
        {new: unit for new, unit in chosen.units.items() if new in mine},
        chosen,
        found.left_out,
    )


def sensors_in(path: Path, topics: Sequence[Topic], columns: Mapping[str, str]) -> list[str]:
    """The names of the magnetometers in a file; one empty name, where it has one alone or ``columns`` says which.

    Raises:
        RecordingError: there are several and nobody can tell which is meant.
    """
    if set(columns) & set(_MAG):
        return [""]
    found = recognised(topics, path.stem)
    if len(found.sensors) > 1 and not found.several:
        raise _ambiguous(path, found)
    return [sensor.name for sensor in found.sensors] or [""]


def which_columns(path: Path, topics: Sequence[Topic]) -> str:
    """What to say where no magnetometer was recognised: the option that names columns which may be one."""
    options = [columns_option(triple) for topic in topics for triple in candidates(topic)]
    if any(_has(topic, "accel") for topic in topics):
        options.append("--sensor accel")
    named = listed(name for topic in topics for name in topic.table.names if name)
    where = "" if len(topics) == 1 else f" in {len(topics)} topics"
    if not options:
        return (
            f"{path}: no magnetometer is recognised among {named}{where}; name its columns: "
            "`--columns mag_x=...,mag_y=...,mag_z=...`."
        )
    accel = options == ["--sensor accel"]
    mean = "An accelerometer is calibrated by" if accel else "If one is meant, name its columns"
    return (
        f"{path}: no magnetometer is recognised among {named}{where}. {mean}: "
        f"{' or '.join(f'`{option}`' for option in options[:6])}."
    )


def _has(topic: Topic, quantity: str) -> bool:
    """Whether the names of a topic say that it holds all axes of a quantity."""
    said = [meaning(name) for name in topic.table.names if name]
    return {one.axis for one in said if one is not None and one.quantity == quantity} >= {"x", "y", "z"}


def columns_option(columns: Mapping[str, str]) -> str:
    """The option that names a magnetometer's columns.

    Example:
        >>> columns_option({"mag_x": "Mag X", "mag_y": "Mag Y", "mag_z": "Mag Z", "time": "t"})
        '--columns "mag_x=Mag X,mag_y=Mag Y,mag_z=Mag Z"'
    """
    text = ",".join(f"{name}={columns[name]}" for name in _MAG)
    return f"--columns {text}" if all(one.isalnum() or one in "_=,.-/:" for one in text) else f'--columns "{text}"'


def _chosen(path: Path, topics: Sequence[Topic], found: RecognisedColumns, sensor: str | None) -> SensorColumns | None:
    names = [one.name for one in found.sensors]
    if sensor is not None:
        same = [one for one in found.sensors if sensor.strip().strip("/").casefold() == one.name.casefold()]
        if not same:
            there = f"there are {listed(names)}" if any(names) else "the file has one alone; leave it out"
            raise RecordingError(
                f"{path}: there is no magnetometer `{sensor}`; {there if names else 'none is recognised'}."
            )
        return same[0]
    if len(found.sensors) < 2:
        return found.sensors[0] if found.sensors else None
    own = [one for one in found.sensors if all(one.columns[name] == name for name in _MAG)]
    if len(own) == 1 and len(topics) == 1:
        return own[0]
    if not found.several:
        raise _ambiguous(path, found)
    raise RecordingError(
        f"{path}: the file holds {len(names)} magnetometers, {listed(names)}; choose one with `--sensor {names[0]}` "
        f'(in Python `sensor="{names[0]}"`, or `recognise=False` for the table as it is).'
    )


def _ambiguous(path: Path, found: RecognisedColumns) -> RecordingError:
    options = " or ".join(f"`{columns_option(sensor.columns)}`" for sensor in found.sensors)
    return RecordingError(
        f"{path}: {len(found.sensors)} triples of columns may be the magnetometer; say which: {options}."
    )


def _as_said(path: Path, topics: Sequence[Topic], columns: Mapping[str, str]) -> ColumnChoice:
    """The topic that has the caller's columns, and its time."""
    number = _topic_of(path, topics, columns)
    topic = topics[number]
    said = {new: _local(old, topic) for new, old in columns.items()}
    time = time_column(topic, weak=bool(set(said) & set(_MAG)))
    mine, units = {}, {}
    if time is not None and "time" not in said and "time" not in topic.table.names and time[0] not in said.values():
        mine, units = {"time": time[0]}, {"time": time[1]} if time[1] else {}
    elif time is not None and said.get("time", "time") == time[0] and time[1]:
        units = {"time": time[1]}
    return ColumnChoice(number, said | mine, mine, units, None, ())


def _topic_of(path: Path, topics: Sequence[Topic], columns: Mapping[str, str]) -> int:
    if len(topics) == 1:
        return 0
    having = [
        number
        for number, topic in enumerate(topics)
        if columns and all(_local(old, topic) in topic.table.names for old in columns.values())
    ]
    if len(having) == 1:
        return having[0]
    names = listed(topic.name for topic in topics)
    if not columns:
        raise RecordingError(
            f"{path}: the file holds {len(topics)} topics, {names}, and no magnetometer is recognised in them; name "
            "columns of one as topic.column: `--columns mag_x=TOPIC.x,mag_y=TOPIC.y,mag_z=TOPIC.z`."
        )
    what = "no topic has" if not having else f"{len(having)} topics have"
    raise MissingColumnError(
        f"{path}: {what} all of {listed(columns.values())}; the file's topics are {names}; write topic.column."
    )


def _local(name: str, topic: Topic) -> str:
    """A column's name in its topic, where the caller wrote the topic before it."""
    name = name.strip()
    for sign in (".", "/"):
        if topic.name and name.startswith(topic.name + sign):
            return name[len(topic.name) + 1 :]
    return name
