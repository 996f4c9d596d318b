"""The magnetometer as a simulation: which view of a recording is compared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.magnetometer.attitude import AttitudeView
from mkc_torch.simulation.magnetometer.choice import chosen_view, requested_view
from mkc_torch.simulation.magnetometer.correction import MagnetometerCorrection
from mkc_torch.simulation.magnetometer.gyro import GyroView
from mkc_torch.simulation.magnetometer.norm import NormView
from mkc_torch.simulation.magnetometer.view import ACCEL, AXES, GYRO, QUATERNION

__all__ = ["Magnetometer"]


@dataclass(frozen=True)
class Magnetometer:
    """``matrix @ (measured - offset)`` is the ambient field in the sensor's axes, of constant strength and direction.

    What is compared depends on the recording. With an attitude, the vector with the world's field. Otherwise, its
    length with the field's, as a distance in the units of the measurement; and where the turns of the sensor do not
    determine it from the length, but there is a gyroscope, the vector with the field of the same two seconds turned
    along. An attitude or a gyroscope that leaves far more of the field than its length does is not used where the
    length determines the sensor, alone or together with what changed it; a warning says which, how much and why.

    Attributes:
        use: "attitude", "norm" or "gyro"; None takes the first of these that the recording allows and that
            explains the field. The length goes before the gyroscope because the drift of a gyroscope enters the vector
            as structure of its own.

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
    def columns(self) -> frozenset[str]:
        return frozenset({"time", *self.measured, *GYRO, *ACCEL, *QUATERNION})

    @property
    def measured(self) -> frozenset[str]:
        return frozenset(f"mag_{a}" for a in AXES)

    def prepare(self, recording: Recording) -> NormView | AttitudeView | GyroView:
        """The magnetometer of a recording.

        Raises:
            MissingColumnError: a column of the magnetometer, or of what ``use`` asks for, is not there.
            RecordingError: too few usable samples.
            NotIdentifiableError: no view determines the sensor; the message names the directions that are missing.
            ValueError: ``use`` is none of the three.
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
