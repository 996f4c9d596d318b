"""Common types of all exports: the correction of a sensor, its destination, and the exported file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from mkc_torch.calibration.field_covariance import field_covariance
from mkc_torch.calibration.file import Matrix, Vector
from mkc_torch.calibration.result import Calibration
from mkc_torch.recording.logged_correction import corrected_already

MADE_BY = "Made by mkc_torch"
"""Marker in every exported file, by which a later export recognises a file that it may replace."""


class ExportError(ValueError):
    """An export cannot represent a correction; the message states why, and what to do."""


@dataclass(frozen=True)
class CurrentCoefficients:
    """The field of a current near the sensor, proportional to the current.

    Attributes:
        per_ampere: field per current in the sensor's axes, in the unit of the correction per A.
        mean: the mean current in A, whose field is part of the offset.
        column: the column of the current in the recording.
    """

    per_ampere: Vector
    mean: float
    column: str


@dataclass(frozen=True)
class SensorCorrection:
    """The correction that all exports write: ``field = matrix @ (measured - offset - per_ampere * (current - mean))``.

    Attributes:
        name: name of the sensor.
        unit: unit of the measurement and of the offset.
        offset: offset, at the mean current if there is a current.
        matrix: matrix from ``unit`` to ``field_unit``.
        field_unit: unit of the corrected field.
        field_strength: length of the corrected field during the calibration, in ``field_unit``; None if unknown.
        current: the field of a current; None without a current.
        left_out: warnings about findings that the correction does not contain.
        corrected_already: sentence on a correction of the measurement before it was logged, which an autopilot would
            apply a second time; empty if the measurement is raw.
        covariance: covariance of the corrected field of an undisturbed sample, in ``field_unit²``; None if unknown.

    Example:
        >>> from mkc_torch.calibration.calibrate import calibrate
        >>> from mkc_torch.recording.demonstration import simulated_recording
        >>> correction = SensorCorrection.of(calibrate(simulated_recording()[0]))
        >>> correction.unit, [round(v) for v in correction.offset]
        ('µT', [12, -8, 21])
    """

    name: str
    unit: str
    offset: Vector
    matrix: Matrix
    field_unit: str
    field_strength: float | None = None
    current: CurrentCoefficients | None = None
    left_out: tuple[str, ...] = ()
    corrected_already: str = ""
    covariance: Matrix | None = None

    @staticmethod
    def of(calibration: Calibration) -> SensorCorrection:
        """The correction of a calibration."""
        c, already = calibration, corrected_already(calibration.notes)
        return SensorCorrection(
            c.name,
            c.unit,
            c.center,
            c.matrix,
            c.field_unit,
            c.field_strength,
            left_out=(already,) if already else (),
            corrected_already=already,
            covariance=field_covariance(c),
        )

    def refuse_corrected(self) -> None:
        """Raise if the measurement was corrected before it was logged: an autopilot needs the total correction.

        Raises:
            ExportError: it was, by parameters that are not known.
        """
        if self.corrected_already:
            raise ExportError(
                f"{self.corrected_already} An autopilot needs the total: calibrate the complete log of the autopilot, "
                "or record with offsets of 0, DIA and SCALE of 1."
            )


class Destination(NamedTuple):
    """The sensor of an autopilot that receives the correction.

    Attributes:
        instance: the autopilot's number of the sensor; None for its first sensor.
        device_id: PX4's device id of the sensor; None if the user enters it later.
    """

    instance: int | None = None
    device_id: int | None = None


class Exported(NamedTuple):
    """The text of a file, and warnings, which the file also contains if it has comments."""

    text: str
    warnings: tuple[str, ...]


class Export(NamedTuple):
    """An export format; a new format is a module of this folder and an entry in ``EXPORTS``.

    Attributes:
        name: name on the command line.
        file: name of the file in the folder of results.
        text: encodes a correction; raises :class:`ExportError` if the format cannot represent it.
        load: how the user loads the file, for the command line's output.
    """

    name: str
    file: str
    text: Callable[[SensorCorrection, Destination], Exported]
    load: str
