"""Export to ArduPilot: a parameter file of Mission Planner and MAVProxy with ``COMPASS_*``.

ArduPilot computes, in milligauss and in the vehicle's axes (ardupilot, ``libraries/AP_Compass/
AP_Compass_Backend.cpp``, ``accumulate_sample`` and ``correct_field``)::

    field = [DIA, ODI] * (SCALE * (reading + OFS)) + MOT * current

The matrix is symmetric, with ``COMPASS_DIA_X`` … on its diagonal and ``ODI_X`` = xy, ``ODI_Y`` = xz, ``ODI_Z`` = yz.
Offsets are added. ``SCALE`` has an effect only between 1/1.5 and 1.5 (``Compass::have_scale_factor``). ``MOT`` has an
effect if ``COMPASS_MOTCT`` is 2; it is multiplied by the battery's current in A and added to the corrected field.
ArduPilot finds ``COMPASS_DEV_ID`` by itself, so it is not written.
"""

from __future__ import annotations

import numpy as np

from mkc_torch.calibration.exports.base import MADE_BY, Destination, Export, Exported, ExportError, SensorCorrection
from mkc_torch.calibration.exports.numbers import one_line, single, symmetric
from mkc_torch.calibration.exports.units import Converted, converted

_INSTANCES = 3
_SCALE = (1.0 / 1.5, 1.5)
"""``COMPASS_MIN_SCALE_FACTOR`` and ``COMPASS_MAX_SCALE_FACTOR`` (``AP_Compass_config.h``)."""

_DIAGONAL = (0.2, 5.0)
"""Range of ``DIA`` that ArduPilot's own calibration accepts (``CompassCalibrator::fit_acceptable``)."""

_OFF_DIAGONAL = 1.0
"""Upper bound of ``ODI`` that ArduPilot's own calibration accepts (``CompassCalibrator::fit_acceptable``)."""

_OFFSET = 1800.0
"""Largest offset in mG with which a vehicle arms (``AP_COMPASS_OFFSETS_MAX_DEFAULT``; set by ``COMPASS_OFFS_MAX``)."""

_MOTOR = 1000.0
"""Largest magnitude of ``COMPASS_MOT_X`` in mG/A (``AP_Compass.cpp``)."""

_FIELD = (185.0, 875.0)
"""Range of the field in mG with which a vehicle arms (``AP_ARMING_COMPASS_MAGFIELD_MIN`` and ``_MAX``,
``AP_Arming.cpp``)."""


def text(correction: SensorCorrection, to: Destination) -> Exported:
    """Write a correction as parameters.

    Raises:
        ExportError: a field that was corrected before it was logged, an unknown unit, a matrix that mirrors, or a
            compass number that ArduPilot does not have.

    Example:
        >>> eye = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        >>> file = text(SensorCorrection("mast", "µT", (12.5, -8.0, 21.0), eye, "µT"), Destination()).text
        >>> [line for line in file.splitlines() if "OFS" in line and "#" not in line]
        ['COMPASS_OFS_X,-125.0', 'COMPASS_OFS_Y,80.0', 'COMPASS_OFS_Z,-210.0']
    """
    number = 1 if to.instance is None else to.instance
    if not 1 <= number <= _INSTANCES:
        raise ExportError(
            f"`--instance` must be 1 to {_INSTANCES}, the numbers of ArduPilot's compasses, but is {number}."
        )
    correction.refuse_corrected()
    found = converted(correction, "mG", "ardupilot")
    matrix, turned = symmetric(found.matrix, "ardupilot")
    size = float(np.linalg.det(matrix)) ** (1.0 / 3.0) if np.linalg.det(matrix) > 0 else 1.0
    scale = size if _SCALE[0] <= size <= _SCALE[1] else 1.0
    shape = matrix / scale
    motor = -matrix @ found.per_ampere
    warnings = [*correction.left_out, *([turned] if turned else []), *_out_of_range(found, shape, motor, size)]
    which = "" if number == 1 else str(number)
    numbers = _named(f"OFS{which}", -found.offset_without_current)
    numbers |= _named(f"DIA{which}", shape.diagonal())
    numbers |= _named(f"ODI{which}", shape[[0, 0, 1], [1, 2, 2]])
    numbers[f"COMPASS_SCALE{which}"] = scale
    if correction.current is not None:
        numbers |= _named(f"MOT{which}", motor)
    rows = [f"{name},{single(value)}" for name, value in numbers.items()]
    if correction.current is not None:
        rows.append("COMPASS_MOTCT,2")
    comments = [*_comments(correction, which), *(one_line(warning) for warning in warnings)]
    return Exported("\n".join([*(f"# {comment}" for comment in comments), *rows]) + "\n", tuple(warnings))


def _named(what: str, values: np.ndarray) -> dict[str, float]:
    return {f"COMPASS_{what}_{axis}": float(value) for axis, value in zip("XYZ", values, strict=True)}


def _comments(correction: SensorCorrection, which: str) -> list[str]:
    comments = [
        f"{MADE_BY}: ArduPilot parameters of the compass {one_line(correction.name)}",
        "field = [DIA ODI] SCALE (reading + OFS) in mG, of readings in the vehicle's axes, after "
        f"COMPASS_ORIENT{which}, which you have to set.",
        "OFS, DIA, ODI and SCALE are totals, which replace the present parameters.",
    ]
    if correction.current is not None:
        comments += [
            "MOT in mG per A of the battery's current is added to the field (old firmware adds it before DIA and ODI);",
            "add the MOT that was set during the recording.",
            f"it was fitted to the column {one_line(correction.current.column)}, which must be that current.",
        ]
    return comments


def _out_of_range(found: Converted, shape: np.ndarray, motor: np.ndarray, size: float) -> list[str]:
    """Warnings about numbers that ArduPilot does not accept."""
    warnings = []
    offset = float(np.abs(found.offset_without_current).max())
    if offset > _OFFSET:
        warnings.append(
            f"ArduPilot does not arm with an offset of more than {_OFFSET:g} mG, but it is {offset:.0f} mG: move the "
            "sensor away from the source of the offset, or set COMPASS_OFFS_MAX."
        )
    if not _SCALE[0] <= size <= _SCALE[1]:
        warnings.append(
            f"ArduPilot accepts a scale from {_SCALE[0]:.2f} to {_SCALE[1]:g}, but it is {size:.3g}; it is included in "
            "DIA and ODI. Check the unit of the columns and the field strength."
        )
    diagonal = [f"{v:.3g}" for v in shape.diagonal() if not _DIAGONAL[0] < v < _DIAGONAL[1]]
    if diagonal:
        warnings.append(
            f"ArduPilot's own calibration accepts DIA from {_DIAGONAL[0]:g} to {_DIAGONAL[1]:g}, but it is "
            f"{', '.join(diagonal)}: check the unit of the columns, and the directions covered."
        )
    if float(np.abs(shape - np.diag(shape.diagonal())).max()) >= _OFF_DIAGONAL:
        warnings.append(
            "ArduPilot's own calibration accepts ODI below 1, but here it is larger: check the columns' order and unit."
        )
    if float(np.abs(motor).max()) > _MOTOR:
        warnings.append(f"COMPASS_MOT is limited to {_MOTOR:g} mG/A: move the sensor away from the power wires.")
    if found.strength is not None and not _FIELD[0] <= found.strength <= _FIELD[1]:
        warnings.append(
            f"ArduPilot arms in a field of {_FIELD[0]:g} to {_FIELD[1]:g} mG, but the corrected field is "
            f"{found.strength:.0f} mG: calibrate again with `--field-strength` and the field at your place in µT."
        )
    return warnings


ARDUPILOT = Export(
    "ardupilot", "ardupilot.param", text, "in Mission Planner: Config, Full Parameter List, Load from file"
)
