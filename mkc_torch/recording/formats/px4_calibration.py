"""The correction that PX4 applied to the readings in ``vehicle_magnetometer``, from the parameters in the log.

PX4 logs the raw reading as ``sensor_mag`` and, as ``vehicle_magnetometer``, ``rotation * (SCALE * (reading - OFF))``
less an estimated bias (PX4-Autopilot, ``src/modules/sensors/vehicle_magnetometer/VehicleMagnetometer.cpp``). It can be
undone without changing the axes if the sensor is not rotated and no bias was estimated.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from mkc_torch.recording.formats.base import LoggedCorrection

_SENSORS = 4
_AXES = ("magnetometer_ga[0]", "magnetometer_ga[1]", "magnetometer_ga[2]")
_NAMES = "CAL_MAG"
_INSTEAD = "calibrate `sensor_mag` of the log instead, which holds the raw readings"


def magnetometer_correction(
    topic: str, columns: Mapping[str, np.ndarray], parameters: Mapping[str, float], changed: Collection[str], bias: bool
) -> LoggedCorrection | None:
    """The correction of a topic ``vehicle_magnetometer``; None for other topics, which are raw.

    Args:
        topic: name of the topic.
        columns: its columns.
        parameters: the parameters at the beginning of the log.
        changed: names of the parameters that changed during the log.
        bias: whether an estimated bias, which is not among the parameters, was subtracted too.

    Example:
        >>> columns = {f"magnetometer_ga[{k}]": np.zeros(2) for k in range(3)} | {"device_id": np.array([9, 9])}
        >>> magnetometer_correction("vehicle_magnetometer", columns, {}, (), False).unknown
        'which the log does not contain; calibrate `sensor_mag` of the log instead, which holds the raw readings'
    """
    if topic != "vehicle_magnetometer" or not set(_AXES) <= set(columns):
        return None
    ids = np.unique(columns["device_id"]).tolist() if "device_id" in columns else []
    known = [n for n in range(_SENSORS) if ids and parameters.get(f"CAL_MAG{n}_ID") == ids[0]]
    sensor = f"CAL_MAG{known[0]}" if known else ""
    offset = [parameters.get(f"{sensor}_{axis}OFF") for axis in "XYZ"]
    if not sensor or len(ids) != 1 or None in offset:
        return LoggedCorrection(_AXES, _NAMES, unknown=f"which the log does not contain; {_INSTEAD}")
    if bias or any(name.startswith(sensor) for name in changed):
        return LoggedCorrection(_AXES, _NAMES, unknown=f"which changed during the log; {_INSTEAD}")
    rotation = parameters.get(f"{sensor}_ROT", 0)
    if rotation > 0 or (rotation < 0 and parameters.get("SENS_BOARD_ROT", 0) != 0):
        return LoggedCorrection(_AXES, _NAMES, unknown=f"which rotates the axes too; {_INSTEAD}")
    scale = [parameters.get(f"{sensor}_{axis}SCALE", 1.0) for axis in "XYZ"]
    xy, xz, yz = (parameters.get(f"{sensor}_{axis}ODIAG", 0.0) for axis in "XYZ")
    matrix = np.array([[scale[0], xy, xz], [xy, scale[1], yz], [xz, yz, scale[2]]])
    rows = np.broadcast_to(-np.array(offset, dtype=float), (len(columns[_AXES[0]]), 3))
    return LoggedCorrection(_AXES, f"{sensor} OFF, SCALE and ODIAG", rows, matrix)
