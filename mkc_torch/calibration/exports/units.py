"""Convert corrections to the unit of an export."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mkc_torch._support.unit_text import ratio
from mkc_torch.calibration.exports.base import ExportError, SensorCorrection

_SPELT = {
    "gauss": ("gs", "ga", "gauß"),
    "mG": ("mgauss", "milligauss", "mga"),
    "T": ("tesla",),
    "µT": ("microtesla",),
    "nT": ("nanotesla",),
    "mT": ("millitesla",),
}
_NAMES = {spelling: unit for unit, spellings in _SPELT.items() for spelling in spellings} | {"gauss": "gauss"}


class Converted(NamedTuple):
    """A correction with measurement and field in the same unit.

    Attributes:
        offset: (3,), at the mean current.
        matrix: (3, 3), no unit.
        per_ampere: (3,), field of the current in the sensor's axes, in the unit per A; zero without a current.
        mean: mean of the current in A.
        strength: length of the field; None if unknown.
        covariance: (3, 3), of the corrected field of an undisturbed sample, in unit²; None if unknown.
    """

    offset: np.ndarray
    matrix: np.ndarray
    per_ampere: np.ndarray
    mean: float
    strength: float | None
    covariance: np.ndarray | None

    @property
    def offset_without_current(self) -> np.ndarray:
        """The offset at zero current, (3,)."""
        return self.offset - self.per_ampere * self.mean


def converted(correction: SensorCorrection, unit: str, kind: str) -> Converted:
    """Convert a correction to a unit of the magnetic field.

    Args:
        correction: correction in any unit.
        unit: unit of the result, such as gauss.
        kind: name of the export, for the message.

    Raises:
        ExportError: the correction is in an unknown unit, such as counts.

    Example:
        >>> eye = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        >>> converted(SensorCorrection("a", "uT", (10.0, 0.0, -20.0), eye, "uT"), "gauss", "px4").offset
        array([ 0.1,  0. , -0.2])
    """
    of_measured, of_field = (unit_ratio(name, unit) for name in (correction.unit, correction.field_unit))
    if of_measured is None or of_field is None:
        found = correction.unit if of_measured is None else correction.field_unit
        raise ExportError(
            f"the calibration is in {found or 'an unknown unit'}, but {kind} needs {unit}; nothing was exported. If "
            "the columns are in a unit of the magnetic field, calibrate again with, for example, `--convert "
            "mag=gauss`; scale raw counts by the sensor's data sheet first."
        )
    current = correction.current
    return Converted(
        offset=np.array(correction.offset) * of_measured,
        matrix=np.array(correction.matrix) * (of_field / of_measured),
        per_ampere=np.zeros(3) if current is None else np.array(current.per_ampere) * of_measured,
        mean=0.0 if current is None else current.mean,
        strength=None if correction.field_strength is None else correction.field_strength * of_field,
        covariance=None if correction.covariance is None else np.array(correction.covariance) * of_field**2,
    )


def is_known(unit: str) -> bool:
    """Whether a text names a unit of the magnetic field.

    Example:
        >>> is_known("mG"), is_known("counts")
        (True, False)
    """
    return unit_ratio(unit, "T") is not None


def unit_ratio(unit: str, other: str) -> float | None:
    """The ratio of a unit of the magnetic field to another unit; None if a unit is unknown."""
    plain = unit.strip().replace("\N{GREEK SMALL LETTER MU}", "\N{MICRO SIGN}")
    return ratio(_NAMES.get(plain.lower(), plain), other)
