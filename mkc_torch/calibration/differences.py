"""Compare a calibration with an older one: differences in standard errors, and their effect on the field."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch

from mkc_torch._support.unit_text import ratio
from mkc_torch.calibration.result import Calibration

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

LEVEL = 0.01
"""Significance level of the comparison of two calibrations, with Bonferroni's correction for the ten numbers, which is
valid for any correlation."""

_AXES = "xyz"
_ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


class Difference(NamedTuple):
    """A number that both calibrations have.

    Attributes:
        name: its name, such as "offset x".
        unit: unit of ``new``, ``old`` and ``error``.
        new, old: its values.
        error: combined standard error, the root of the sum of both squares; NaN if either is unknown.
    """

    name: str
    unit: str
    new: float
    old: float
    error: float

    @property
    def in_errors(self) -> float:
        """New minus old in combined standard errors; NaN if these are unknown."""
        if self.new == self.old:
            return 0.0
        return (self.new - self.old) / self.error if self.error != 0.0 else math.copysign(math.inf, self.new - self.old)


class Differences(NamedTuple):
    """The differences between two calibrations.

    Attributes:
        name: name of the old calibration.
        numbers: the offset, the six entries of the matrix, and the radius. If each calibration uses its own radius as
            field strength, a changed field or common gain shows only in the radius.
        limit: largest insignificant difference, in combined standard errors.
        samples: number of measurements at which the corrected fields are compared.
        angle_max, angle_rms: angle between the two corrected fields, in degrees.
        length_max, length_rms: difference of their lengths, in ``unit``.
        unit: unit of the corrected field.
    """

    name: str
    numbers: tuple[Difference, ...]
    limit: float
    samples: int
    angle_max: float
    angle_rms: float
    length_max: float
    length_rms: float
    unit: str

    @property
    def known(self) -> tuple[Difference, ...]:
        """The differences whose errors are known."""
        return tuple(number for number in self.numbers if not math.isnan(number.in_errors))

    @property
    def beyond(self) -> tuple[Difference, ...]:
        """The differences beyond the limit, the largest first."""
        found = [number for number in self.known if abs(number.in_errors) > self.limit]
        return tuple(sorted(found, key=lambda number: -abs(number.in_errors)))


def differences(new: Calibration, old: Calibration, points: Float[Tensor, "N 3"]) -> Differences:
    """Compare two calibrations of a sensor.

    Args:
        new: the new calibration, in whose units all differences are.
        old: the old calibration, in any unit that can be converted to these.
        points: measurements of the new recording, in its unit, at which the corrected fields are compared.

    Raises:
        ValueError: their units cannot be converted to each other.

    Example:
        >>> from mkc_torch.calibration.calibrate import calibrate
        >>> from mkc_torch.recording.demonstration import simulated_recording
        >>> first, second = (simulated_recording(seed)[0] for seed in (0, 1))
        >>> found = differences(calibrate(second), calibrate(first), second.magnetometer())
        >>> found.beyond, found.angle_max < 0.2
        ((), True)
    """
    measured, field = ratio(old.unit, new.unit), ratio(old.field_unit, new.field_unit)
    if measured is None or field is None:
        raise ValueError(
            f"the calibration {old.name} is from {old.unit} to {old.field_unit} and the new calibration from "
            f"{new.unit} to {new.field_unit}, which cannot be compared; calibrate both with the same unit options, and "
            "both with or both without `--field-strength`."
        )
    center = points.new_tensor(old.center) * measured
    matrix = points.new_tensor(old.matrix) * (field / measured)
    center_se = points.new_tensor(old.center_se) * measured
    matrix_se = points.new_tensor(old.matrix_se) * (field / measured)
    numbers = [
        Difference(
            f"offset {_AXES[i]}",
            new.unit,
            new.center[i],
            float(center[i]),
            math.hypot(new.center_se[i], float(center_se[i])),
        )
        for i in range(3)
    ]
    per = "" if new.unit == new.field_unit else f"{new.field_unit} per {new.unit}"
    numbers += [
        Difference(
            f"matrix {_AXES[i]}{_AXES[j]}",
            per,
            new.matrix[i][j],
            float(matrix[i, j]),
            math.hypot(new.matrix_se[i][j], float(matrix_se[i, j])),
        )
        for i, j in _ENTRIES
    ]
    numbers.append(
        Difference(
            "radius",
            new.unit,
            new.radius,
            old.radius * measured,
            math.hypot(_of_radius(new), measured * _of_radius(old)),
        )
    )
    ours, theirs = new.corrected(points), (points - center) @ matrix.mT
    angle = torch.rad2deg(_angle(ours, theirs))
    length = torch.linalg.vector_norm(ours, dim=-1) - torch.linalg.vector_norm(theirs, dim=-1)
    tail = LEVEL / (2.0 * len(numbers))
    return Differences(
        name=old.name or old.recording,
        numbers=tuple(numbers),
        limit=-float(torch.special.ndtri(torch.tensor(tail, dtype=torch.float64))),
        samples=len(points),
        angle_max=float(angle.max()),
        angle_rms=float(angle.square().mean().sqrt()),
        length_max=float(length.abs().max()),
        length_rms=float(length.square().mean().sqrt()),
        unit=new.field_unit,
    )


def _of_radius(calibration: Calibration) -> float:
    """Upper bound of the standard error of the geometric mean of the semi-axes, for any correlation of their errors."""
    pairs = zip(calibration.semi_axes, calibration.semi_axes_se, strict=True)
    return calibration.radius * sum(error / axis for axis, error in pairs) / 3.0


def _angle(a: Float[Tensor, "N 3"], b: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
    """Angles between vectors in rad, accurate for small angles too, unlike an arc cosine."""
    across = torch.linalg.vector_norm(torch.linalg.cross(a, b), dim=-1)
    return torch.atan2(across, (a * b).sum(-1))
