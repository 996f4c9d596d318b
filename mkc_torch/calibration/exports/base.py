"""What every export has in common: the correction of a sensor, where it goes, and what comes of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from mkc_torch.calibration.file import Matrix, Vector
from mkc_torch.calibration.result import Calibration

__all__ = ["MADE_BY", "CurrentCoefficients", "Destination", "Export", "ExportError", "Exported", "SensorCorrection"]

MADE_BY = "Made by mkc_torch"
"""Stands in every file, so that a later run knows it as one that it may replace."""


class ExportError(ValueError):
    """A correction that a kind of file cannot hold; the sentence says why, and what to do."""


@dataclass(frozen=True)
class CurrentCoefficients:
    """The field of a current near the sensor, in proportion to it.

    Attributes:
        per_ampere: in the sensor's axes, in the unit of the correction per A.
        mean: the current in A at which it is part of the offset.
        column: of the recording that the current stood in.
    """

    per_ampere: Vector
    mean: float
    column: str


@dataclass(frozen=True)
class SensorCorrection:
    """``field = matrix @ (measured - offset - per_ampere * (current - mean))``: what all exports write, each its way.

    Attributes:
        name: what the sensor is called.
        unit: of what is measured, and of the offset.
        offset: at the mean current, where a current is.
        matrix: from ``unit`` to ``field_unit``.
        field_unit: of the corrected field.
        field_strength: its length where the correction was made, in ``field_unit``; None where it is not known.
        current: the field of a current; None where none was found.
        left_out: sentences about what was found and is not in it.

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

    @staticmethod
    def of(calibration: Calibration) -> SensorCorrection:
        """That of a calibration."""
        c = calibration
        return SensorCorrection(c.name, c.unit, c.center, c.matrix, c.field_unit, c.field_strength)


class Destination(NamedTuple):
    """Where on a vehicle a sensor is.

    Attributes:
        instance: the autopilot's own number of the sensor; None for its first.
        device_id: PX4's identity of the sensor; None where the user enters it.
    """

    instance: int | None = None
    device_id: int | None = None


class Exported(NamedTuple):
    """A file's text, and sentences about what to notice; these stand in it too, where it has comments."""

    text: str
    warnings: tuple[str, ...]


class Export(NamedTuple):
    """A kind of file that a correction is exported to; a new one is a file of this folder and an entry in ``EXPORTS``.

    Attributes:
        name: as the command line has it.
        file: name of the file in a folder of results.
        text: what stands in it; raises :class:`ExportError` where it cannot hold the correction.
        load: how a user brings it in, for the command line to say.
    """

    name: str
    file: str
    text: Callable[[SensorCorrection, Destination], Exported]
    load: str
