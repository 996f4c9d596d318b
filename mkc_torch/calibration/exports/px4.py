"""Export to PX4: a parameter file of QGroundControl with ``CAL_MAG*``.

PX4 computes, in gauss and in the sensor's own axes (PX4-Autopilot, ``Correct`` of
``src/lib/sensor_calibration/Magnetometer.hpp``)::

    field = rotation * (scale * ((data + power * compensation) - offset))

``scale`` is symmetric, with ``CAL_MAGn_XSCALE`` … on its diagonal and ``XODIAG`` = xy, ``YODIAG`` = xz, ``ZODIAG`` = yz
(``Magnetometer.cpp``, ``set_offdiagonal``). ``power`` is a battery's current in kA while the vehicle is armed, and 0
otherwise; ``CAL_MAG_COMP_TYP`` 2 selects the first battery (``VehicleMagnetometer.cpp``). The file has the format of
QGroundControl's ``ParameterManager::writeParametersToStream``: vehicle, component, name, value and MAVLink type.
"""

from __future__ import annotations

import numpy as np

from mkc_torch.calibration.exports.base import MADE_BY, Destination, Export, Exported, ExportError, SensorCorrection
from mkc_torch.calibration.exports.numbers import one_line, single, symmetric
from mkc_torch.calibration.exports.units import converted

_REAL32, _INT32 = 9, 6  # MAV_PARAM_TYPE
_INSTANCES = 4
_LARGEST_ID = 2**31 - 1
_SCALE = (0.1, 3.0)
"""Range of ``CAL_MAGn_XSCALE`` (PX4-Autopilot, ``src/modules/sensors/module.yaml``)."""


def text(correction: SensorCorrection, to: Destination) -> Exported:
    """Write a correction as parameters.

    Raises:
        ExportError: a field that was corrected before it was logged, an unknown unit, a matrix that mirrors, or a
            sensor number that PX4 does not have.

    Example:
        >>> eye = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        >>> file = text(SensorCorrection("mast", "µT", (12.5, -8.0, 21.0), eye, "µT"), Destination()).text
        >>> [line for line in file.splitlines() if "XOFF" in line]
        ['1\\t1\\tCAL_MAG0_XOFF\\t0.125\\t9']
    """
    number = 0 if to.instance is None else to.instance
    if not 0 <= number < _INSTANCES:
        raise ExportError(
            f"`--instance` must be 0 to {_INSTANCES - 1}, the numbers of PX4's magnetometers, but is {number}."
        )
    if to.device_id is not None and not 0 < to.device_id <= _LARGEST_ID:
        raise ExportError(
            f"`--device-id` must be a whole number from 1 to {_LARGEST_ID}, but is {to.device_id}; `listener "
            "sensor_mag` in PX4's console shows the id."
        )
    correction.refuse_corrected()
    found = converted(correction, "gauss", "px4")
    scale, turned = symmetric(found.matrix, "px4")
    warnings = [*correction.left_out, *([turned] if turned else []), *_out_of_range(scale)]
    sensor = f"CAL_MAG{number}"
    numbers = _named(sensor, "OFF", found.offset_without_current)
    numbers |= _named(sensor, "SCALE", scale.diagonal())
    numbers |= _named(sensor, "ODIAG", scale[[0, 0, 1], [1, 2, 2]])
    if correction.current is not None:
        numbers |= _named(sensor, "COMP", -1000.0 * found.per_ampere)
    rows = [f"1\t1\t{name}\t{single(value)}\t{_REAL32}" for name, value in numbers.items()]
    if to.device_id is not None:
        rows.insert(0, f"1\t1\t{sensor}_ID\t{to.device_id}\t{_INT32}")
    if correction.current is not None:
        rows.append(f"1\t1\tCAL_MAG_COMP_TYP\t2\t{_INT32}")
    comments = [*_comments(correction, sensor, to), *(one_line(warning) for warning in warnings)]
    head = [f"# {comment}" for comment in comments]
    return Exported("\n".join([*head, "#", "# Vehicle-Id Component-Id Name Value Type", *rows]) + "\n", tuple(warnings))


def _named(sensor: str, what: str, values: np.ndarray) -> dict[str, float]:
    return {f"{sensor}_{axis}{what}": float(value) for axis, value in zip("XYZ", values, strict=True)}


def _comments(correction: SensorCorrection, sensor: str, to: Destination) -> list[str]:
    identity = (
        f"You have to set {sensor}_ID, the id of the calibrated sensor, and {sensor}_ROT, its mounting."
        if to.device_id is None
        else f"You have to set {sensor}_ROT, the sensor's mounting."
    )
    comments = [
        f"{MADE_BY}: PX4 parameters of the magnetometer {one_line(correction.name)}",
        f"field = SCALE (reading - OFF) in gauss, of readings as in the topic sensor_mag, before {sensor}_ROT.",
        identity,
    ]
    if correction.current is not None:
        comments += [
            "COMP in gauss per kA of the first battery's current is added to the reading while the vehicle is armed;",
            f"it was fitted to the column {one_line(correction.current.column)}, which must be that current.",
        ]
    return comments


def _out_of_range(scale: np.ndarray) -> list[str]:
    least, most = _SCALE
    outside = [f"{value:.3g}" for value in scale.diagonal() if not least <= value <= most]
    if not outside:
        return []
    return [
        f"PX4 accepts scales from {least:g} to {most:g}, but here they are {', '.join(outside)}: check the unit of the "
        "columns and the field strength."
    ]


PX4 = Export("px4", "px4.params", text, "in QGroundControl: Vehicle Setup, Parameters, Tools, Load from file")
