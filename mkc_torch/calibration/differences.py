"""A calibration beside an older one: what differs, by how many standard errors, and what that does to the field."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch

from mkc_torch._support.unit_text import ratio
from mkc_torch.calibration.result import Calibration

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

__all__ = ["LEVEL", "Difference", "Differences", "differences"]

LEVEL = 0.01
"""Probability at most with which two calibrations of an unchanged sensor are said to differ: shared out among the ten
numbers (Bonferroni), which holds however they are correlated."""

_AXES = "xyz"
_ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


class Difference(NamedTuple):
    """One of the ten numbers in both calibrations.

    Attributes:
        name: such as "offset x".
        unit: of new, old and error.
        new, old: its values.
        error: combined standard error, the root of the sum of both squares; NaN where one is not known.
    """

    name: str
    unit: str
    new: float
    old: float
    error: float

    @property
    def in_errors(self) -> float:
        """New less old in combined standard errors; NaN where these are not known."""
        if self.new == self.old:
            return 0.0
        return (self.new - self.old) / self.error if self.error != 0.0 else math.copysign(math.inf, self.new - self.old)


class Differences(NamedTuple):
    """A calibration less another.

    Attributes:
        name: of the other one.
        numbers: the offset, the six entries of the matrix, and the radius: a field or a gain of all axes that changed
            shows there alone, where each calibration has its own field's length.
        limit: of what is still within errors, in combined standard errors.
        samples: measurements that the corrected fields are compared at.
        angle_max, angle_rms: between the two corrected fields, in degrees.
        length_max, length_rms: difference of their lengths, in ``unit``.
        unit: of the corrected field.
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
        """Those whose errors are known."""
        return tuple(one for one in self.numbers if not math.isnan(one.in_errors))

    @property
    def beyond(self) -> tuple[Difference, ...]:
        """Those beyond the limit, the largest first."""
        found = [one for one in self.known if abs(one.in_errors) > self.limit]
        return tuple(sorted(found, key=lambda one: -abs(one.in_errors)))


def differences(new: Calibration, old: Calibration, points: Float[Tensor, "N 3"]) -> Differences:
    """Two calibrations of a sensor side by side.

    Args:
        new: whose units all is told in.
        old: the other one, in any unit that can be converted to them.
        points: measurements of the new one's recording, in its unit: the directions where the fields are compared.

    Raises:
        ValueError: their units cannot be converted to one another.

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
            f"the calibration {old.name} is from {old.unit} to {old.field_unit} and this one from {new.unit} to "
            f"{new.field_unit}, which cannot be set beside one another; calibrate both with the same `--unit`, and "
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
    """Standard error at most of the geometric mean of the semi-axes, however their errors are correlated."""
    pairs = zip(calibration.semi_axes, calibration.semi_axes_se, strict=True)
    return calibration.radius * sum(error / axis for axis, error in pairs) / 3.0


def _angle(a: Float[Tensor, "N 3"], b: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
    """Between vectors, in rad: exact for small angles too, where an arc cosine is not."""
    across = torch.linalg.vector_norm(torch.linalg.cross(a, b), dim=-1)
    return torch.atan2(across, (a * b).sum(-1))
