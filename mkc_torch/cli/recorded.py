"""Read recordings for the commands. A magnetometer whose unit can only be guessed is refused."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from mkc_torch.recording.choice import sensors_in, which_columns
from mkc_torch.recording.formats import read_topics
from mkc_torch.recording.formats.base import RecordingError, Topic
from mkc_torch.recording.load import REQUIRED_COLUMNS, LoadedTable, read_file
from mkc_torch.recording.recognise import recognised
from mkc_torch.recording.recording import Recording
from mkc_torch.recording.row_sensors import with_row_sensors
from mkc_torch.recording.unit_warnings import field_size, likely_unit
from mkc_torch.recording.unit_words import conversion, factors

_AXES = ("mag_x", "mag_y", "mag_z")


def sensor_names(
    path: Path, columns: Mapping[str, str], sensor: str | None, topics: Sequence[Topic] | None = None
) -> list[str | None]:
    """Return the names of the magnetometers in a file; a single one has the name None.

    ``topics`` are the file's tables, if they are read already.

    Raises:
        RecordingError: the columns of the magnetometer are ambiguous.
    """
    if sensor is not None:
        return [sensor]
    names = sensors_in(path, with_row_sensors(read_topics(path) if topics is None else topics), columns)
    return [None] if len(names) == 1 else list(names)


def refuse_no_magnetometer(path: Path, columns: Mapping[str, str], sensor: str | None) -> None:
    """Raise if no magnetometer is recognised or named.

    Raises:
        RecordingError: there is none; the message names the option for its columns.
    """
    topics = with_row_sensors(read_topics(path))
    if sensor is None and not set(_AXES) & set(columns) and not recognised(topics, path.stem).sensors:
        raise RecordingError(which_columns(path, topics))


def read_magnetometer(
    path: Path,
    columns: Mapping[str, str],
    units: Mapping[str, str],
    sensor: str | None,
    topics: Sequence[Topic] | None = None,
) -> tuple[Recording, LoadedTable]:
    """Read a recording of a magnetometer; ``topics`` are the file's tables, if they are read already.

    Raises:
        RecordingError: the file has no magnetometer, or no unit is given and the size of the field suggests another
            unit than µT.
    """
    found = read_file(path, REQUIRED_COLUMNS, columns=columns, units=units, sensor=sensor, topics=topics)
    if not set(_AXES) & set(found.columns):
        raise RecordingError(which_columns(path, read_topics(path)))
    recording = _recording(path, found)
    if set(_AXES) <= set(found.columns) and not set(_AXES) & found.with_stated_unit:
        size = field_size(recording)
        if size is not None:
            refuse_likely_size(path, size)
    return recording, found


def read_accelerometer(
    path: Path, columns: Mapping[str, str], units: Mapping[str, str], topics: Sequence[Topic] | None = None
) -> Recording:
    """Read a recording of an accelerometer; ``topics`` are the file's tables, if they are read already.

    Raises:
        MissingColumnError: its columns are neither recognised nor named.
    """
    recording = _recording(path, read_file(path, REQUIRED_COLUMNS, columns=columns, units=units, topics=topics))
    recording.stack("accel_x", "accel_y", "accel_z")
    return recording


def read_table(path: Path, columns: Mapping[str, str], units: Mapping[str, str]) -> Recording:
    """Read a recording for the user's own simulation; columns keep their names, less units in brackets."""
    return _recording(path, read_file(path, REQUIRED_COLUMNS, columns=columns, units=units, recognise=False))


class ReadAgain(NamedTuple):
    """A recording to correct.

    Attributes:
        recording: its columns.
        topics: the tables of the file.
        topic: index of the table that was read.
        stated: columns whose unit the file or the user states.
    """

    recording: Recording
    topics: Sequence[Topic]
    topic: int
    stated: frozenset[str]


def read_again(
    path: Path, columns: Mapping[str, str], units: Mapping[str, str], sensor: str | None, *, recognise: bool
) -> ReadAgain:
    """Read a recording to correct.

    Args:
        path, columns, units, sensor: see :func:`read_magnetometer`.
        recognise: whether columns are recognised as those of a sensor; False for the user's own simulation.
    """
    topics = read_topics(path)
    found = read_file(
        path, REQUIRED_COLUMNS, columns=columns, units=units, sensor=sensor, recognise=recognise, topics=topics
    )
    return ReadAgain(_recording(path, found), topics, found.topic, found.with_stated_unit)


def unit_option(quantity: str, unit: str) -> str:
    """Return the option that gives a quantity this unit, as calibrated.

    Example:
        >>> unit_option("mag", "counts"), unit_option("accel", "m/s²")
        ('--unit-label counts', '--convert accel=m/s2')
    """
    known = conversion(quantity, unit)
    typed = next((name for name, factor in factors(quantity).items() if known and factor == known.factor), unit)
    return f"--unit-label {unit}" if known is None else f"--convert {quantity}={typed}"


def refuse_likely_size(path: Path, size: float) -> None:
    """Raise if the field has the size of the Earth's field in another unit.

    Args:
        path: the recording, for the message.
        size: length of the field, taken to be in µT.

    Raises:
        RecordingError: the unit is likely another; the message names the option that gives it.
    """
    likely = likely_unit(size)
    if likely is not None:
        name, option = likely
        raise RecordingError(
            f"{path}: the magnetometer measures about {size:.3g} µT, which is not the size of the Earth's field; in "
            f"{name} it would be. If that is its unit, give `--convert mag={option}`; if not, give its unit: "
            "`--convert mag=uT` or `--unit-label counts`."
        )


def _recording(path: Path, found: LoadedTable) -> Recording:
    name = f"{path.stem}/{found.sensor}" if found.sensor else path.stem
    return Recording(found.columns, name=name, units=found.units, warnings=found.warnings, labels=found.labels)
