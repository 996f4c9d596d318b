"""The magnetometer as a simulation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mkc_torch.recording.join_recordings import Clock
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.magnetometer.attitude import AttitudeView
from mkc_torch.simulation.magnetometer.correction import MagnetometerCorrection
from mkc_torch.simulation.magnetometer.gyro import GyroView
from mkc_torch.simulation.magnetometer.norm import NormView
from mkc_torch.simulation.magnetometer.view import ACCEL, AXES, GYRO, QUATERNION
from mkc_torch.simulation.magnetometer.view_selection import chosen_view, requested_view


@dataclass(frozen=True)
class Magnetometer:
    """``matrix @ (measured - offset)`` is the ambient field in the sensor frame, of constant strength and direction.

    The comparison depends on the recording. With an attitude, the field vector is compared with the ambient field in
    the world frame. Otherwise its length is compared with the field strength, as a distance in the unit of the
    measurement; where the turns of the sensor do not determine it from the length but there is a gyroscope, the vector
    is compared with the field within windows of 2 s, rotated by the gyroscope. An attitude or a gyroscope with a far
    larger residual than the length's is not used if the length determines the sensor, alone or together with a change
    of it; a warning states the residuals and the probable fault.

    Attributes:
        use: "attitude", "norm" or "gyro"; None selects the first of these that the recording allows and that explains
            the field. The length is preferred to the gyroscope, whose drift adds structure to the vector's residual.

    Example:
        >>> from mkc_torch.recording.demonstration import simulated_recording
        >>> prepared_simulation = Magnetometer().prepare(simulated_recording()[0])
        >>> prepared_simulation.channels, prepared_simulation.unit
        (('norm',), 'µT')
    """

    use: str | None = None
    name: str = "magnetometer"

    @property
    def joins_experiments(self) -> bool:
        return False

    @property
    def joint_clock(self) -> Clock:
        return "follow"

    @property
    def columns(self) -> frozenset[str]:
        return frozenset({"time", *self.measured, *GYRO, *ACCEL, *QUATERNION})

    @property
    def measured(self) -> frozenset[str]:
        return frozenset(f"mag_{a}" for a in AXES)

    def prepare(self, recording: Recording) -> NormView | AttitudeView | GyroView:
        """The magnetometer together with a recording.

        Raises:
            MissingColumnError: a column of the magnetometer, or a column that ``use`` requires, is missing.
            RecordingError: too few usable samples.
            NotIdentifiableError: no view determines the sensor; the message names the missing directions.
            ValueError: ``use`` has another value.
        """
        if self.use not in (None, "attitude", "gyro", "norm"):
            raise ValueError(f"Expected argument `use` to be 'attitude', 'gyro', 'norm' or None but got {self.use!r}.")
        if self.use is None:
            return chosen_view(recording)
        if self.use == "gyro":
            recording["time"]
        return requested_view(recording, self.use)

    def correction(self, state: Mapping[str, Any], recording: Recording) -> MagnetometerCorrection:
        """The calibrated sensor on a new recording; see :class:`mkc_torch.simulation.Correction`."""
        return MagnetometerCorrection(state, recording)
