"""The calibrated field of a fitted magnetometer in any recording of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch

from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.magnetometer.matrix import MATRIX_OF_VIEW
from mkc_torch.simulation.magnetometer.view import AXES
from mkc_torch.simulation.ports import Changes, Port

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

_PARAMETERS = {"norm": 9, "gyro": 15, "attitude": 14}
"""Number of parameters of each view."""


class MagnetometerCorrection:
    """``matrix @ (measured - change - offset)`` on any recording of the sensor.

    Args:
        state: state of the fitted view.
        recording: a recording with ``mag_x``, ``mag_y``, ``mag_z``.

    Raises:
        ValueError: the state has an unknown view.
    """

    def __init__(self, state: Mapping[str, Any], recording: Recording) -> None:
        if state.get("view") not in MATRIX_OF_VIEW:
            raise ValueError(f"The model's view is {state.get('view')!r} and not one of {', '.join(MATRIX_OF_VIEW)}.")
        self._matrix, self._count = MATRIX_OF_VIEW[state["view"]], _PARAMETERS[state["view"]]
        self.measured = recording.magnetometer()
        self.recording = recording
        known = recording.time
        self.time = torch.arange(len(recording), dtype=torch.float64) if known is None else known
        self.ports = {"sensor": Port(AXES, recording.units["mag_x"])}

    def corrected(self, theta: Float[Tensor, " p"], changes: Changes) -> dict[str, Float[Tensor, " N"]]:
        """The calibrated field as ``field_x``, ``field_y``, ``field_z``.

        Raises:
            ValueError: the number of parameters does not fit the view.
        """
        if len(theta) != self._count:
            raise ValueError(
                f"The model has {len(theta)} parameters of its sensor and not {self._count}; it may be of another "
                "version: diagnose the recording again."
            )
        away = self.measured - theta[:3]
        if "sensor" in changes:
            away = away - changes["sensor"](away)
        field = away @ self._matrix(theta).mT
        time = {} if self.recording.time is None else {"time": self.recording.time}
        return time | dict(zip(("field_x", "field_y", "field_z"), field.unbind(-1), strict=True))
