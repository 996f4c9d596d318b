"""A recording as a command takes it: read, of one sensor, and refused where its unit can only be guessed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from mkc_torch.recording.choice import sensors_in, which_columns
from mkc_torch.recording.formats import read_topics
from mkc_torch.recording.formats.base import RecordingError, Topic
from mkc_torch.recording.reading import ASKED, LoadedTable, read_file
from mkc_torch.recording.recognise import recognised
from mkc_torch.recording.recording import Recording
from mkc_torch.recording.row_sensors import with_row_sensors
from mkc_torch.recording.unit_warnings import RECORDED, field_size, likely_unit

__all__ = [
    "read_accelerometer",
    "read_again",
    "read_magnetometer",
    "read_table",
    "refuse_likely_size",
    "refuse_no_magnetometer",
    "sensor_names",
]

_AXES = ("mag_x", "mag_y", "mag_z")


def sensor_names(
    path: Path, columns: Mapping[str, str], sensor: str | None, topics: Sequence[Topic] | None = None
) -> list[str | None]:
    """The magnetometers of a file that are to be taken one by one; None where it has one alone.

    ``topics`` are the file's tables, where they have been read already.

    Raises:
        RecordingError: nobody can tell which columns are meant.
    """
    if sensor is not None:
        return [sensor]
    names = sensors_in(path, with_row_sensors(read_topics(path) if topics is None else topics), columns)
    return [None] if len(names) == 1 else list(names)


def refuse_no_magnetometer(path: Path, columns: Mapping[str, str], sensor: str | None) -> None:
    """Refuse a file in which no magnetometer is recognised or named.

    Raises:
        RecordingError: none is; the sentence has the option that names its columns.
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
    """Read a recording of a magnetometer; ``topics`` are the file's tables, where they have been read already.

    Raises:
        RecordingError: no magnetometer in it, or one whose size says that it is in another unit than it should be, and
            nothing says which it is.
    """
    found = read_file(path, ASKED, columns=columns, units=units, sensor=sensor, topics=topics)
    if not set(_AXES) & set(found.columns):
        raise RecordingError(which_columns(path, read_topics(path)))
    recording = _recording(path, found)
    if set(_AXES) <= set(found.columns) and not set(_AXES) & found.said:
        size = field_size(recording)
        if size is not None:
            refuse_likely_size(path, size)
    return recording, found


def read_accelerometer(
    path: Path, columns: Mapping[str, str], units: Mapping[str, str], topics: Sequence[Topic] | None = None
) -> Recording:
    """Read a recording of an accelerometer; ``topics`` are the file's tables, where they have been read already.

    Raises:
        MissingColumnError: no column of one is recognised or named.
    """
    recording = _recording(path, read_file(path, ASKED, columns=columns, units=units, topics=topics))
    recording.stack("accel_x", "accel_y", "accel_z")
    return recording


def read_table(path: Path, columns: Mapping[str, str], units: Mapping[str, str]) -> Recording:
    """Read a recording for a simulation of the user's own, whose columns have the names that they have."""
    return _recording(path, read_file(path, ASKED, columns=columns, units=units, recognise=False))


def read_again(
    path: Path,
    columns: Mapping[str, str],
    units: Mapping[str, str],
    sensor: str | None,
    *,
    made_in: str,
    of_field: bool,
) -> tuple[Recording, int]:
    """Read a recording that something made before is applied to, and the number of its topic.

    Args:
        path, columns, units, sensor: as :func:`read_magnetometer` takes them.
        made_in: unit of the measurements that it was made from; empty where it is not known.
        of_field: whether it is of a magnetometer, and not of a simulation of the user's own.

    Raises:
        RecordingError: the recording's unit is said and another.
    """
    found = read_file(path, ASKED, columns=columns, units=units, sensor=sensor, recognise=of_field)
    recording = _recording(path, found)
    said = [name for name in _AXES if name in found.said]
    if of_field and said and made_in not in ("", RECORDED) and recording.units[said[0]] != made_in:
        raise RecordingError(
            f"{path}: the magnetometer is in {recording.units[said[0]]}, but this was made of measurements in "
            f"{made_in}; convert the columns, or say their unit with `--unit mag={made_in}`."
        )
    return recording, found.topic


def refuse_likely_size(path: Path, size: float) -> None:
    """Refuse a field that is the Earth's in another unit: what is only likely is asked for.

    Args:
        path: of the recording, for the message.
        size: of the field, in what is taken for µT.

    Raises:
        RecordingError: it is; the sentence has the option that says so.
    """
    likely = likely_unit(size)
    if likely is not None:
        name, option = likely
        raise RecordingError(
            f"{path}: the magnetometer measures about {size:.3g} µT, which is not the size of the Earth's field; in "
            f"{name} it would be. If it is, say so with `--unit mag={option}`; if not, name its unit: `--unit mag=uT`, "
            "`--unit counts`."
        )


def _recording(path: Path, found: LoadedTable) -> Recording:
    name = f"{path.stem}/{found.sensor}" if found.sensor else path.stem
    return Recording(found.columns, name=name, units=found.units, warnings=found.warnings, labels=found.labels)
