"""Choose the topic of a file and its columns: those that the caller names, else those that are recognised."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from mkc_torch.recording.column_names import meaning, split_unit
from mkc_torch.recording.formats.base import MissingColumnError, RecordingError, Topic, listed
from mkc_torch.recording.recognise import RecognisedColumns, SensorColumns, candidates, recognised, time_column

_MAG = ("mag_x", "mag_y", "mag_z")


class ColumnChoice(NamedTuple):
    """The topic and the columns that are read from a file.

    Attributes:
        topic: index of the topic.
        columns: new name to the name in the topic.
        found: the part of ``columns`` that was recognised and renamed.
        units: recognised units by new name.
        sensor: the magnetometer; None if the columns are not read as a magnetometer.
        warnings: sentences about topics that were left out.
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
    """Choose the topic and its columns.

    Args:
        path: path of the file, for messages.
        topics: topics of the file.
        columns: the caller's columns, new name to the name in the file; ``topic.column`` in a file of several topics.
        sensor: name of the magnetometer if the file has several.
        recognise: recognise columns by their names.

    Raises:
        RecordingError: several magnetometers without ``sensor``, or no magnetometer of that name.
        MissingColumnError: ``columns`` names a column that no topic has.
    """
    if set(columns) & set(_MAG) or not recognise:
        if sensor is not None:
            raise RecordingError(f"{path}: got both a sensor and the magnetometer's columns; give only one of them.")
        return _by_given_columns(path, topics, columns)
    found = recognised(topics, path.stem)
    chosen = _chosen(path, topics, found, sensor)
    if chosen is None:
        return _by_given_columns(path, topics, columns)
    topic = topics[chosen.topic]
    given = {new: _local(old, topic) for new, old in columns.items()}
    recognised_columns = {
        new: old
        for new, old in chosen.columns.items()
        if new not in given
        and old not in given.values()
        and (new == old or new in _MAG or new not in topic.table.names)  # columns of the chosen sensor take precedence
    }
    return ColumnChoice(
        chosen.topic,
        given | recognised_columns,
        {new: old for new, old in recognised_columns.items() if new != old},
        {new: unit for new, unit in chosen.units.items() if new in recognised_columns},
        chosen,
        found.left_out,
    )


def sensors_in(path: Path, topics: Sequence[Topic], columns: Mapping[str, str]) -> list[str]:
    """Names of the magnetometers in a file; ``[""]`` if it has only one or ``columns`` names its axes.

    Raises:
        RecordingError: several triples of columns may be the magnetometer.
    """
    if set(columns) & set(_MAG):
        return [""]
    found = recognised(topics, path.stem)
    if len(found.sensors) > 1 and not found.several:
        raise _ambiguous(path, found)
    return [sensor.name for sensor in found.sensors] or [""]


def which_columns(path: Path, topics: Sequence[Topic]) -> str:
    """Error message if no magnetometer was recognised: the options that name the columns in question."""
    options = [columns_option(triple) for topic in topics for triple in candidates(topic)]
    if any(_has(topic, "accel") for topic in topics):
        options.append("--quantity accel")
    named = listed(name for topic in topics for name in topic.table.names if name)
    where = "" if len(topics) == 1 else f" in {len(topics)} topics"
    if not options:
        example = _example(topics)
        if not example:
            return f"{path}: no magnetometer is recognised among {named}{where}; it needs three columns of numbers."
        return (
            f"{path}: no magnetometer is recognised among {named}{where}; name its columns, for example "
            f"`{columns_option(example)}`."
        )
    accel = options == ["--quantity accel"]
    mean = "An accelerometer is calibrated by" if accel else "If these columns are a magnetometer, name them"
    return (
        f"{path}: no magnetometer is recognised among {named}{where}. {mean}: "
        f"{' or '.join(f'`{option}`' for option in options[:6])}."
    )


_COUNTERS = {"experiment", "run", "sample", "row", "index", "id"}
"""Names of columns that number rows or runs."""


def _example(topics: Sequence[Topic]) -> dict[str, str]:
    """Three columns of the first table by axis, none of which is a time, a counter or another sensor; else empty."""
    for topic in topics:
        names = [n for n in topic.table.names if n and meaning(n) is None and n.casefold() not in _COUNTERS]
        if len(names) >= len(_MAG):
            return dict(zip(_MAG, names, strict=False))
    return {}


def _has(topic: Topic, quantity: str) -> bool:
    """Whether a topic has columns for all axes of a quantity, by their names."""
    meanings = [meaning(name) for name in topic.table.names if name]
    return {known.axis for known in meanings if known is not None and known.quantity == quantity} >= {"x", "y", "z"}


def columns_option(columns: Mapping[str, str]) -> str:
    """The command-line option that names a magnetometer's columns.

    Example:
        >>> columns_option({"mag_x": "Mag X", "mag_y": "Mag Y", "mag_z": "Mag Z", "time": "t"})
        '--columns "mag_x=Mag X,mag_y=Mag Y,mag_z=Mag Z"'
    """
    text = ",".join(f"{name}={columns[name]}" for name in _MAG)
    return f"--columns {text}" if all(c.isalnum() or c in "_=,.-/:" for c in text) else f'--columns "{text}"'


def _chosen(path: Path, topics: Sequence[Topic], found: RecognisedColumns, sensor: str | None) -> SensorColumns | None:
    names = [candidate.name for candidate in found.sensors]
    if sensor is not None:
        same = [
            candidate
            for candidate in found.sensors
            if sensor.strip().strip("/").casefold() == candidate.name.casefold()
        ]
        if not same:
            there = (
                f"there are {listed(names)}" if any(names) else "the file has a single magnetometer; omit the sensor"
            )
            raise RecordingError(
                f"{path}: there is no magnetometer `{sensor}`; {there if names else 'no magnetometer is recognised'}."
            )
        return same[0]
    if len(found.sensors) < 2:
        return found.sensors[0] if found.sensors else None
    own = [candidate for candidate in found.sensors if all(candidate.columns[name] == name for name in _MAG)]
    if len(own) == 1 and len(topics) == 1:
        return own[0]
    if not found.several:
        raise _ambiguous(path, found)
    raise RecordingError(
        f"{path}: the file holds {len(names)} magnetometers, {listed(names)}; choose one with `--sensor {names[0]}` "
        f'(in Python `sensor="{names[0]}"`, or `recognise=False` to read the table unchanged).'
    )


def _ambiguous(path: Path, found: RecognisedColumns) -> RecordingError:
    options = " or ".join(f"`{columns_option(sensor.columns)}`" for sensor in found.sensors)
    return RecordingError(
        f"{path}: {len(found.sensors)} triples of columns may be the magnetometer; choose: {options}."
    )


def _by_given_columns(path: Path, topics: Sequence[Topic], columns: Mapping[str, str]) -> ColumnChoice:
    """The topic that has the caller's columns, and its time column; ``height [m]`` is taken as ``height``."""
    number = _topic_of(path, topics, columns)
    topic = topics[number]
    given = {new: _local(old, topic) for new, old in columns.items()}
    time = time_column(topic, weak=bool(set(given) & set(_MAG)))
    recognised_columns, units = {}, {}
    if time is not None and "time" not in given and "time" not in topic.table.names and time[0] not in given.values():
        recognised_columns, units = {"time": time[0]}, {"time": time[1]} if time[1] else {}
    elif time is not None and given.get("time", "time") == time[0] and time[1]:
        units = {"time": time[1]}
    taken = {*given.values(), *recognised_columns.values()}
    recognised_columns |= {
        new: old
        for new, old in _without_units(topic.table.names).items()
        if old not in taken and new not in given and new not in recognised_columns
    }
    return ColumnChoice(number, given | recognised_columns, recognised_columns, units, None, ())


def _without_units(names: Sequence[str]) -> dict[str, str]:
    """Names without the unit in brackets behind them, to the names in the file, where the plain name is unique."""
    plain = [split_unit(name)[0] for name in names]
    return {new: old for new, old in zip(plain, names, strict=True) if new != old and plain.count(new) == 1}


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
            "its columns as topic.column: `--columns mag_x=TOPIC.x,mag_y=TOPIC.y,mag_z=TOPIC.z`."
        )
    what = "no topic has" if not having else f"{len(having)} topics have"
    raise MissingColumnError(
        f"{path}: {what} all of {listed(columns.values())}; the file's topics are {names}; write topic.column."
    )


def _local(name: str, topic: Topic) -> str:
    """A column's name without the prefix of its topic."""
    name = name.strip()
    for separator in (".", "/"):
        if topic.name and name.startswith(topic.name + separator):
            return name[len(topic.name) + 1 :]
    return name
