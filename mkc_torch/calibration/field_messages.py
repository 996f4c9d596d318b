"""The corrected field as the fields of ROS's ``sensor_msgs/MagneticField``: tesla, and a covariance for each sample."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch.calibration.exports.units import unit_ratio
from mkc_torch.calibration.field_covariance import field_covariance, field_noise
from mkc_torch.calibration.result import Calibration

if TYPE_CHECKING:
    from jaxtyping import Float


class MagneticFieldMessages(NamedTuple):
    """Fields of ``sensor_msgs/MagneticField`` for N samples.

    Attributes:
        magnetic_field: (N, 3), in T; NaN where the measurement is missing.
        magnetic_field_covariance: (N, 9), in T², row by row.
    """

    magnetic_field: Float[Tensor, "N 3"]
    magnetic_field_covariance: Float[Tensor, "N 9"]

    def columns(self) -> dict[str, Float[Tensor, " N"]]:
        """The fields by their names in a bag's table: ``magnetic_field.x`` …, ``magnetic_field_covariance[0]`` …"""
        field = {f"magnetic_field.{axis}": v for axis, v in zip("xyz", self.magnetic_field.unbind(-1), strict=True)}
        entries = enumerate(self.magnetic_field_covariance.unbind(-1))
        return field | {f"magnetic_field_covariance[{i}]": v for i, v in entries}


def magnetic_field_messages(
    calibration: Calibration, measured: Float[Tensor, "N 3"], *, largest_error: float | None = None
) -> MagneticFieldMessages:
    """Correct measurements and state a bounded error of each, also of a disturbed sample.

    The error of an undisturbed sample is the sensor's noise and the offset's uncertainty. For a sample of robust weight
    w, the noise's variance is divided by w; it is at least the square of the length's error,
    ``| |field| - field_strength |``, and at most ``largest_error²``. So a filter keeps every sample and gives a
    disturbed sample little weight. A disturbance that turns the field without changing its length is not
    detected.

    Args:
        calibration: of a magnetometer, with a field in a unit of the magnetic field.
        measured: (N, 3), in the calibration's unit.
        largest_error: largest standard deviation in T; the calibration's ``field_strength`` if None, beyond which a
            sample holds no information on the direction.

    Raises:
        ValueError: an accelerometer, a field in an unknown unit such as counts, or a largest error below the noise.

    References:
        ROS, sensor_msgs/msg/MagneticField, https://docs.ros.org/en/jazzy/p/sensor_msgs/msg/MagneticField.html: field
        in tesla, covariance "row major about x, y, z axes", all zeros for an unknown covariance.

    Example:
        >>> from mkc_torch.calibration.calibrate import calibrate
        >>> from mkc_torch.recording.demonstration import simulated_recording
        >>> recording, _ = simulated_recording()
        >>> messages = magnetic_field_messages(calibrate(recording), recording.magnetometer())
        >>> error = messages.magnetic_field_covariance[:, 0].sqrt()  # T; disturbed samples reach the bound
        >>> [f"{1e6 * float(v):.1f} µT" for v in (error.median(), error.max())]
        ['0.5 µT', '48.2 µT']
    """
    c = calibration
    tesla = _tesla(c)
    noise = tesla * field_noise(c)
    bound = tesla * c.field_strength if largest_error is None else largest_error
    if not noise <= bound < math.inf:
        raise ValueError(
            f"Expected argument `largest_error` in T, at least the sensor's noise of {noise:.3g} T, but got {bound}."
        )
    measured = measured.to(torch.float64)
    field = tesla * c.corrected(measured)
    misfit = torch.linalg.vector_norm(field, dim=-1) - tesla * c.field_strength
    variance = torch.maximum(noise**2 / c.weight(measured), misfit.square())
    variance = variance.nan_to_num(nan=bound**2).clamp(noise**2, bound**2)
    eye = torch.eye(3, dtype=torch.float64, device=measured.device)
    usual = tesla**2 * torch.tensor(field_covariance(c), dtype=torch.float64, device=measured.device)
    covariance = usual + (variance - noise**2)[:, None, None] * eye
    return MagneticFieldMessages(field, covariance.flatten(1))


def _tesla(calibration: Calibration) -> float:
    if calibration.sensor != "mag":
        raise ValueError(
            "The calibration is of an accelerometer; sensor_msgs/MagneticField needs the calibration of a magnetometer."
        )
    found = unit_ratio(calibration.field_unit, "T")
    if found is None:
        raise ValueError(
            f"The corrected field is in {calibration.field_unit or 'an unknown unit'}, but sensor_msgs/MagneticField "
            "is in T; calibrate again with `--convert mag=gauss`, or the columns' unit, or with `--field-strength`."
        )
    return found
