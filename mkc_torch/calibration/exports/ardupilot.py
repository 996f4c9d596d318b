"""ArduPilot: a parameter file of Mission Planner and MAVProxy with ``COMPASS_*``.

What ArduPilot computes, in milligauss and in the vehicle's axes (ardupilot, ``libraries/AP_Compass/
AP_Compass_Backend.cpp``, ``accumulate_sample`` and ``correct_field``)::

    field = [DIA, ODI] * (SCALE * (reading + OFS)) + MOT * current

The matrix is symmetric, with ``COMPASS_DIA_X`` … on its diagonal and ``ODI_X`` = xy, ``ODI_Y`` = xz, ``ODI_Z`` = yz.
Offsets are added. ``SCALE`` counts input_hold 1/1.5 and 1.5 alone (``Compass::have_scale_factor``). ``MOT`` acts where
``COMPASS_MOTCT`` is 2, by the battery's current in A, and on the corrected field. ArduPilot finds ``COMPASS_DEV_ID`` by
itself, so it is not written.
"""

from __future__ import annotations

import numpy as np

from mkc_torch.calibration.exports.base import (
    MADE_BY,
    Destination,
    Export,
    Exported,
    ExportError,
    SensorCorrection,
)
from mkc_torch.calibration.exports.numbers import one_line, single, symmetric
from mkc_torch.calibration.exports.units import Converted, converted

__all__ = ["ARDUPILOT"]

_INSTANCES = 3
_SCALE = (1.0 / 1.5, 1.5)
"""``COMPASS_MIN_SCALE_FACTOR`` and ``COMPASS_MAX_SCALE_FACTOR`` (``AP_Compass_config.h``)."""

_DIAGONAL, _OFF_DIAGONAL = (0.2, 5.0), 1.0
"""What ArduPilot's own calibration accepts (``CompassCalibrator::fit_acceptable``)."""

_OFFSET = 1800.0
"""Largest offset in mG with which a vehicle arms (``AP_COMPASS_OFFSETS_MAX_DEFAULT``; ``COMPASS_OFFS_MAX`` sets it)."""

_MOTOR = 1000.0
"""Range of ``COMPASS_MOT_X`` in mG/A (``AP_Compass.cpp``)."""

_FIELD = (185.0, 875.0)
"""Field in mG with which a vehicle arms (``AP_ARMING_COMPASS_MAGFIELD_MIN`` and ``_MAX``, ``AP_Arming.cpp``)."""


def text(correction: SensorCorrection, to: Destination) -> Exported:
    """The parameters of a correction.

    Raises:
        ExportError: a unit whose size is not known, a matrix that mirrors, or a compass that ArduPilot does not have.

    Example:
        >>> eye = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        >>> file = text(SensorCorrection("mast", "µT", (12.5, -8.0, 21.0), eye, "µT"), Destination()).text
        >>> [line for line in file.splitlines() if "OFS" in line and "#" not in line]
        ['COMPASS_OFS_X,-125.0', 'COMPASS_OFS_Y,80.0', 'COMPASS_OFS_Z,-210.0']
    """
    number = 1 if to.instance is None else to.instance
    if not 1 <= number <= _INSTANCES:
        raise ExportError(f"ArduPilot numbers its compasses 1 to {_INSTANCES}, but `--instance` is {number}.")
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
        f"COMPASS_ORIENT{which}, which is yours to set.",
        "A log's MAG message is corrected already: it is the reading where OFS, ODI and MOT were 0, DIA and SCALE 1.",
    ]
    if correction.current is not None:
        comments += [
            "MOT in mG per A of the battery's current is added to the field (old firmware adds it before DIA and ODI);",
            f"it was found by the column {one_line(correction.current.column)}, which has to be that current.",
        ]
    return comments


def _out_of_range(found: Converted, shape: np.ndarray, motor: np.ndarray, size: float) -> list[str]:
    """Sentences about numbers that ArduPilot takes for mistakes."""
    told = []
    offset = float(np.abs(found.offset_without_current).max())
    if offset > _OFFSET:
        told.append(
            f"ArduPilot does not arm with an offset of more than {_OFFSET:g} mG, and {offset:.0f} mG is one: move the "
            "sensor away from what makes it, or set COMPASS_OFFS_MAX."
        )
    if not _SCALE[0] <= size <= _SCALE[1]:
        told.append(
            f"ArduPilot counts a scale from {_SCALE[0]:.2f} to {_SCALE[1]:g} alone, and {size:.3g} lies outside; it is "
            "in DIA and ODI. Check the unit of the columns and the field strength."
        )
    diagonal = [f"{v:.3g}" for v in shape.diagonal() if not _DIAGONAL[0] < v < _DIAGONAL[1]]
    if diagonal:
        told.append(
            f"ArduPilot's own calibration refuses DIA outside {_DIAGONAL[0]:g} to {_DIAGONAL[1]:g}, as here "
            f"{', '.join(diagonal)}: check the unit of the columns, and the directions covered."
        )
    if float(np.abs(shape - np.diag(shape.diagonal())).max()) >= _OFF_DIAGONAL:
        told.append(
            "ArduPilot's own calibration refuses ODI of 1 and more, as here: check the columns' order and unit."
        )
    if float(np.abs(motor).max()) > _MOTOR:
        told.append(f"ArduPilot's COMPASS_MOT goes to {_MOTOR:g} mG/A: move the sensor away from the power wires.")
    if found.strength is not None and not _FIELD[0] <= found.strength <= _FIELD[1]:
        told.append(
            f"ArduPilot does not arm in a field outside {_FIELD[0]:g} to {_FIELD[1]:g} mG, and the corrected one has "
            f"{found.strength:.0f} mG: calibrate again with `--field-strength` and the field at your place in µT."
        )
    return told


ARDUPILOT = Export(
    "ardupilot", "ardupilot.param", text, "in Mission Planner: Config, Full Parameter List, Load from file"
)
