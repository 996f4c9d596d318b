"""Recognise the magnetometers in a file, and the columns that belong to each."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from mkc_torch._support.note import Note
from mkc_torch.recording.column_names import Meaning, form, is_about_magnetometer, is_derived, meaning, split_unit
from mkc_torch.recording.formats.base import Topic
from mkc_torch.recording.px4 import PX4_UNITS, is_px4_magnetometer, is_px4_message
from mkc_torch.recording.unit_words import conversion

_MAG = ("mag_x", "mag_y", "mag_z")
_SIZES = {"mag": "xyz", "gyro": "xyz", "accel": "xyz", "q": "wxyz"}
_ROS = "magnetic_field"
"""Field of ROS's sensor_msgs/MagneticField, "Measurements in Teslas"."""

_OF_ROS = (f"{_ROS}_covariance", "header.stamp", "header.seq", "frame_id", "rosbagTimestamp")
"""Further columns by which a ROS message is recognised."""

_DERIVED = {"vehicle_magnetometer": "sensor_mag", "sensor_combined": "sensor_mag"}
"""PX4 topics that repeat a sensor's topic, and that topic."""


class SensorColumns(NamedTuple):
    """A magnetometer in a file, and the columns recorded with it.

    Attributes:
        name: the name by which it is chosen; empty if the file has a single magnetometer.
        topic: index of its topic.
        columns: new name to the name in the topic.
        units: units that the file states, by new name.
    """

    name: str
    topic: int
    columns: Mapping[str, str]
    units: Mapping[str, str]


class RecognisedColumns(NamedTuple):
    """The magnetometers recognised in a file.

    Attributes:
        sensors: the magnetometers.
        several: True if they are distinct sensors; if False, more than one entry means an ambiguous choice.
        left_out: warnings about topics that only repeat others.
    """

    sensors: tuple[SensorColumns, ...]
    several: bool
    left_out: tuple[str, ...] = ()


class _Group(NamedTuple):
    """The columns and units of a vector by axis, or of a scalar by the empty axis."""

    sensor: str
    columns: dict[str, str]
    units: dict[str, str]
    sure: bool


def recognised(topics: Sequence[Topic], file: str = "") -> RecognisedColumns:
    """Recognise the magnetometers in a file by the names of columns, topics and the file.

    Columns with canonical names are taken as they are. Columns x, y, z belong to a magnetometer if the name of the
    topic or file, or other columns, show it. A magnetometer has all three axes.

    Args:
        topics: topics of the file.
        file: name of the file without its ending.

    Example:
        >>> from mkc_torch.recording.formats.base import Table
        >>> table = Table(["t", "mag0_x", "mag0_y", "mag0_z", "mag1_x", "mag1_y", "mag1_z"], [], [])
        >>> [(sensor.name, sensor.columns["mag_x"]) for sensor in recognised([Topic("", table)]).sensors]
        [('mag0', 'mag0_x'), ('mag1', 'mag1_x')]
    """
    found = [
        (number, group) for number, topic in enumerate(topics) for group in _magnetometers(topic, file, len(topics))
    ]
    found, left_out = _without_derived(topics, found)
    if any(group.sure for _, group in found):
        found = [(number, group) for number, group in found if group.sure]
    own = [(number, group) for number, group in found if _is_own(group)]
    forms = {(number, form(group.sensor)) for number, group in found}
    several = len(topics) > 1 or len(forms) == 1
    if own and not several:
        found, several = own, True
    names = _names(topics, found)
    sensors = [
        _sensor(topics, number, group, name if len(found) > 1 else "")
        for (number, group), name in zip(found, names, strict=True)
    ]
    return RecognisedColumns(tuple(sensors), several, left_out)


def candidates(topic: Topic) -> list[dict[str, str]]:
    """Triples of columns that differ only by x, y, z and may be a magnetometer, for an error message.

    Example:
        >>> from mkc_torch.recording.formats.base import Table
        >>> candidates(Topic("", Table(["time", "ux", "uy", "uz"], [], [])))
        [{'mag_x': 'ux', 'mag_y': 'uy', 'mag_z': 'uz'}]
    """
    names = [name for name in topic.table.names if name and not _is_other(name)]
    found = _numbered(names)
    for name in names:
        for place in [i for i, letter in enumerate(name) if letter in "xX"]:
            triple = [_with(name, place, letter) for letter in ("y", "z")]
            if all(other in names for other in triple):
                found.append(dict(zip(_MAG, (name, *triple), strict=True)))
    return found


def _is_other(name: str) -> bool:
    """Whether a name belongs to another sensor."""
    known = meaning(name)
    return known is not None and known.quantity != "mag"


def _numbered(names: Sequence[str]) -> list[dict[str, str]]:
    """Triples of columns with equal names that end with 0, 1, 2 or 1, 2, 3."""
    stems: dict[tuple[str, str], dict[int, str]] = {}
    for name in names:
        if found := re.fullmatch(r"(.*?)(\d+)([\])]?)", name):
            stems.setdefault((found[1], found[3]), {})[int(found[2])] = name
    return [
        dict(zip(_MAG, [by_number[n] for n in sorted(by_number)], strict=True))
        for by_number in stems.values()
        if sorted(by_number) in ([0, 1, 2], [1, 2, 3])
    ]


def time_column(topic: Topic, *, weak: bool = True) -> tuple[str, str] | None:
    """The time column of a topic and its unit, empty if unknown; None if there is no time column.

    Args:
        topic: a topic of a file.
        weak: accept a column ``t`` without a unit too.

    Example:
        >>> from mkc_torch.recording.formats.base import Table
        >>> time_column(Topic("", Table(["timestamp [ns]", "x"], [], [])))
        ('timestamp [ns]', 'ns')
    """
    found = []
    for place, name in enumerate(topic.table.names):
        known = meaning(name) if name else None
        if known is None or known.quantity != "time" or not (weak or known.sure or _is_timed(name, known.unit)):
            continue
        rank = next(
            (i for i, usual in enumerate(("time", "timestamp", "header_stamp")) if known.sensor == usual),
            3 if known.sure else 4,
        )
        found.append((rank, place, name, _unit_of(topic, name, known.unit)))
    if not found:
        return None
    _, _, name, unit = min(found)
    return name, unit


def _is_timed(name: str, unit: str) -> bool:
    """Whether a column t states a unit of time, as ``t_s``; ``T`` is usually a temperature or a torque."""
    return bool(unit) and name.strip().startswith("t")


def companion_columns(topics: Sequence[Topic], own: int) -> list[tuple[int, dict[str, str], dict[str, str]]]:
    """Recognised columns of the topics other than the magnetometer's: topic index, new name to name, and units.

    A topic with the same trailing number as the magnetometer's topic comes first, then the order of the file.
    """
    last = re.search(r"\d*$", topics[own].name)
    mine = last[0] if last else ""
    order = sorted(
        (number for number in range(len(topics)) if number != own),
        key=lambda number: not (mine and re.search(rf"(?<!\d){mine}$", topics[number].name)),
    )
    return [
        (number, columns, units)
        for number in order
        for columns, units in _companions([*_groups(topics[number]), *_by_topic(topics[number])], "", set())
    ]


def _by_topic(topic: Topic) -> list[tuple[str, _Group]]:
    """The gyroscope or accelerometer with columns x, y, z, recognised by the name of its topic."""
    axes = {name.lower(): name for name in topic.table.names if name.lower() in ("x", "y", "z")}
    known = meaning(f"{topic.name}_x") if len(axes) == 3 else None
    if known is None or known.quantity not in ("gyro", "accel"):
        return []
    units = {axis: _unit_of(topic, name, "") for axis, name in axes.items()}
    return [(known.quantity, _Group(known.sensor, axes, units, True))]


def _with(name: str, place: int, letter: str) -> str:
    return name[:place] + (letter.upper() if name[place].isupper() else letter) + name[place + 1 :]


def _unit_of(topic: Topic, name: str, unit: str) -> str:
    if topic.units.get(name) or unit:
        return topic.units.get(name) or unit
    if name.rpartition(".")[0].endswith(_ROS) and any(
        part in column for column in topic.table.names for part in _OF_ROS
    ):
        return "tesla"
    return PX4_UNITS["time"] if name.startswith("timestamp") and is_px4_message(topic.table.names) else ""


def _magnetometers(topic: Topic, file: str, topics: int) -> list[_Group]:
    """The magnetometers of a topic, by its columns; columns x, y, z count by the name of the topic or file."""
    groups = [group for quantity, group in _groups(topic) if quantity == "mag"]
    if any(group.sure for group in groups):
        return groups
    plain = {name: split_unit(name) for name in topic.table.names if name}
    axes = {base.lower(): (name, unit) for name, (base, unit) in plain.items() if base.lower() in ("x", "y", "z")}
    known = topic.name if topics > 1 or topic.name else file
    px4 = is_px4_magnetometer(topic.table)
    parent = _parent(topic, [name for name, _ in axes.values()])
    if len(axes) == 3 and parent:
        unit = "tesla" if parent == _ROS and any(part in topic.table.names for part in _OF_ROS) else ""
        units = {axis: own or unit for axis, (_, own) in axes.items()}
        return [_Group("mag", {axis: name for axis, (name, _) in axes.items()}, units, True)]
    sure = px4 or is_about_magnetometer(known) or all(_is_magnetic(unit) for _, unit in axes.values())
    if len(axes) == 3 and (sure or _has_no_header(topic)):
        units = {axis: _unit_of(topic, name, unit) for axis, (name, unit) in axes.items()}
        if is_px4_message(topic.table.names):
            units = {axis: unit or PX4_UNITS["mag"] for axis, unit in units.items()}
        return [_Group("mag", {axis: name for axis, (name, _) in axes.items()}, units, True)]
    return groups or _by_unit(topic)


def _by_unit(topic: Topic) -> list[_Group]:
    """The only three columns that differ by x, y, z and state a unit of a magnetic field, whatever their names."""
    found = []
    for triple in candidates(topic):
        units = {name[-1]: _unit_of(topic, column, split_unit(column)[1]) for name, column in triple.items()}
        if all(_is_magnetic(unit) for unit in units.values()) and not any(map(is_derived, triple.values())):
            found.append(_Group("mag", {name[-1]: column for name, column in triple.items()}, units, True))
    return found if len(found) == 1 else []


def _has_no_header(topic: Topic) -> bool:
    """Whether a table is three columns of numbers without names, as loggers of a single sensor write them."""
    return topic.table.names == ["x", "y", "z"] and any("has no header" in note for note in topic.warnings)


def _is_magnetic(unit: str) -> bool:
    """Whether a unit is a unit of a magnetic field and not of an acceleration (g may be both)."""
    return bool(unit) and conversion("mag", unit) is not None and conversion("accel", unit) is None


def _parent(topic: Topic, axes: Sequence[str]) -> str:
    """The empty column before x, y, z that names their field in a flattened ROS message; empty if there is none."""
    names = topic.table.names
    places = [names.index(name) for name in axes]
    if len(places) != 3 or sorted(places) != list(range(min(places), min(places) + 3)) or min(places) == 0:
        return ""
    place = min(places) - 1
    if not is_about_magnetometer(names[place]) or not topic.table.series:
        return ""
    cells = topic.table.series[place]
    return names[place] if all(cell is None or not str(cell).strip() for cell in cells) else ""


def _groups(topic: Topic) -> list[tuple[str, _Group]]:
    """The complete vectors and the scalars of a topic, each with its quantity."""
    found: dict[tuple[str, str, bool], _Group] = {}
    for name in topic.table.names:
        known = meaning(name) if name else None
        if known is None or known.quantity == "time":
            continue
        key = (known.quantity, known.sensor, known.sure)
        group = found.setdefault(key, _Group(known.sensor, {}, {}, known.sure))
        if known.axis in group.columns:  # two spellings of the same name
            group.columns[known.axis] = ""
            continue
        group.columns[known.axis] = name
        group.units[known.axis] = _unit_of(topic, name, known.unit)
    return [
        (quantity, group)
        for (quantity, _, _), group in found.items()
        if all(group.columns.get(axis) for axis in _SIZES.get(quantity, ("",)))
    ]


def _without_derived(
    topics: Sequence[Topic], found: list[tuple[int, _Group]]
) -> tuple[list[tuple[int, _Group]], tuple[str, ...]]:
    """Leave out topics that PX4 derives from sensors whose own topics are in the file."""
    kinds = {number: re.sub(r"_?\d+$", "", topics[number].name) for number, _ in found}
    gone = {number for number, kind in kinds.items() if _DERIVED.get(kind) in kinds.values()}
    warnings = tuple(
        Note(
            f"Topic `{topics[number].name}` is left out: it is derived from `{_DERIVED[kinds[number]]}`, which is read."
        )
        for number in sorted(gone)
    )
    return [(number, group) for number, group in found if number not in gone], warnings


def _is_own(group: _Group) -> bool:
    return [group.columns.get(axis) for axis in "xyz"] == list(_MAG)


def _names(topics: Sequence[Topic], found: Sequence[tuple[int, _Group]]) -> list[str]:
    """Name each sensor by its topic, its columns, or both if the topic holds several sensors."""
    numbers = [number for number, _ in found]
    names = []
    for number, group in found:
        topic = topics[number].name.strip("/")
        if not topic or len(topics) == 1:
            names.append(group.sensor)
        else:
            names.append(topic if numbers.count(number) == 1 else f"{topic}/{group.sensor}")
    return names


def _sensor(topics: Sequence[Topic], number: int, group: _Group, name: str) -> SensorColumns:
    topic = topics[number]
    columns = {f"mag_{axis}": group.columns[axis] for axis in "xyz"}
    units = {f"mag_{axis}": group.units[axis] for axis in "xyz" if group.units[axis]}
    if (time := time_column(topic)) is not None:
        columns["time"] = time[0]
        units |= {"time": time[1]} if time[1] else {}
    for names, their_units in _companions(_groups(topic), group.sensor, set(columns.values())):
        columns |= names
        units |= their_units
    return SensorColumns(name, number, columns, units)


def _companions(
    groups: Iterable[tuple[str, _Group]], sensor: str, taken: set[str]
) -> Iterable[tuple[dict[str, str], dict[str, str]]]:
    """Yield columns and units of the other quantities; of several groups, the group with the sensor's number."""
    number = re.search(r"\d*$", sensor)
    mine = number[0] if number else ""
    by_quantity: dict[str, list[_Group]] = {}
    for quantity, group in groups:
        if quantity != "mag" and not taken & set(group.columns.values()):
            by_quantity.setdefault(quantity, []).append(group)
    for quantity, found in by_quantity.items():
        sure = [group for group in found if group.sure] or found
        own = [group for group in sure if all(name == _called(quantity, axis) for axis, name in group.columns.items())]
        same = [group for group in sure if mine and group.sensor.endswith(mine)]
        chosen = own or (same if len(same) == 1 else sure)
        if len(chosen) == 1:
            group = chosen[0]
            columns = {_called(quantity, axis): name for axis, name in group.columns.items()}
            yield columns, {_called(quantity, axis): unit for axis, unit in group.units.items() if unit}


def _called(quantity: str, axis: str) -> str:
    return Meaning(quantity, axis, "", "", True).column
