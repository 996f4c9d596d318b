"""Advice on columns without any finite value."""

from __future__ import annotations

from collections.abc import Sequence

from mkc_torch.recording.formats.base import listed

_SENSORS = {"mag": "magnetometer", "gyro": "gyroscope", "accel": "accelerometer", "q": "attitude"}
_AXES = {"q": "wxyz"}


def without_values(names: Sequence[str]) -> str:
    """What to do about columns that hold no finite value at all; ``names`` is empty if each has values in some rows.

    Example:
        >>> without_values(["mag_z"]).partition(":")[0]
        'The axis z of the magnetometer is dead, or was not recorded'
        >>> without_values([])
        'No row has values in all of these columns: resample them to common times.'
    """
    if not names:
        return "No row has values in all of these columns: resample them to common times."
    sensors = dict.fromkeys(name.rpartition("_")[0] for name in names)
    if not all(
        sensor in _SENSORS and name.rpartition("_")[2] in _AXES.get(sensor, "xyz")
        for sensor, name in ((name.rpartition("_")[0], name) for name in names)
    ):
        return (
            f"{listed(names)} {'holds' if len(names) == 1 else 'hold'} no values; name other columns, or record again."
        )
    sentences = []
    for sensor in sensors:
        axes = [name.rpartition("_")[2] for name in names if name.rpartition("_")[0] == sensor]
        what = (
            f"axis {axes[0]} of the {_SENSORS[sensor]} is"
            if len(axes) == 1
            else (f"axes {', '.join(axes)} of the {_SENSORS[sensor]} are")
        )
        sentences.append(
            f"The {what} dead, or was not recorded: all axes are needed. Check the sensor, its wiring and the logger, "
            f"and record again; if another column holds the values, name it: `--columns {sensor}_{axes[0]}=COLUMN`; if "
            "the file has another sensor, select it with `--sensor`."
        )
    return " ".join(sentences)
