"""The base class of all views of a magnetometer: the measured field and the sensor's model."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.calibration.ellipsoid_fit import EllipsoidFit
from mkc_torch.calibration.turning import refuse_at_rest, thin_at_rest, turning
from mkc_torch.linear import LeastTrimmedSquares
from mkc_torch.nonlinear import NoFitError
from mkc_torch.recording.logged_correction import corrected_already
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.magnetometer.matrix import MATRIX_OF_VIEW
from mkc_torch.simulation.ports import Changes, FreeChange, Nearby, Port
from mkc_torch.simulation.protocol import ClosedForm

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

QUATERNION = ("q_w", "q_x", "q_y", "q_z")
GYRO = ("gyro_x", "gyro_y", "gyro_z")
ACCEL = ("accel_x", "accel_y", "accel_z")
AXES = ("x", "y", "z")

VECTOR = ("along", "across_1", "across_2")
"""Channels of a compared vector: along the field, and two axes across it."""

INDEPENDENT = (True, False, False)
"""Independence of the channels: errors of a rotation are across the field, in the residual and in the signal."""

_MOSTLY = 0.5
"""Share of the recording at rest from which there is a warning."""

_ENOUGH = 1500
"""Number of samples for the start of a fit."""


class View(ClosedForm):
    """The measured field, the sensor's model, and their comparison."""

    name = "magnetometer"
    view: str
    ports: dict[str, Port]
    strength: float
    bounds: tuple[Tensor, Tensor] | None = None

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self.measured = recording.magnetometer()
        turns = turning(self.measured)
        self.unit = recording.units["mag_x"]
        refuse_at_rest(self.measured, turns, self.unit)
        self.thin = thin_at_rest(self.measured)
        self.warnings = _rests(turns)

    @property
    def state(self) -> dict[str, str | float]:
        """Constants for the correction of another recording: the view, and the field strength with its unit.

        A correction of the field before it was logged that was not undone is a sentence, ``corrected_already``.
        """
        already = corrected_already(self.recording.notes)
        more = {"corrected_already": already} if already else {}
        return {"view": self.view, "unit": self.unit, "strength": self.strength, **more}

    def start(self, rows: Bool[Tensor, " N"] | None = None) -> Float[Tensor, " p"]:
        """A robust guess of the parameters; see :meth:`mkc_torch.simulation.PreparedSimulation.start`."""
        raise NotImplementedError

    @cached_property
    def time(self) -> Float[Tensor, " N"]:
        known = self.recording.time
        return torch.arange(len(self.recording), dtype=torch.float64) if known is None else known

    def signals(
        self, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None = None
    ) -> Mapping[str, Float[Tensor, "N 3"]]:
        """At the port "sensor", the simulated measurement without the offset."""
        # not the measured field: its noise is also in the residual, and would look like a nonlinearity
        return {"sensor": self.simulated(theta)}

    def simulated(self, theta: Float[Tensor, " p"]) -> Float[Tensor, "N 3"]:
        """The simulated measurement without the offset, (N, 3)."""
        raise NotImplementedError

    def matrix(self, theta: Float[Tensor, " p"]) -> Float[Tensor, "3 3"]:
        """The calibration matrix, (3, 3)."""
        return MATRIX_OF_VIEW[self.view](theta)

    def corrected(self, theta: Float[Tensor, " p"], changes: Changes) -> Float[Tensor, "N 3"]:
        """The calibrated field, with the changes at the port "sensor" removed from the measurement."""
        return self._away(theta, changes) @ self.matrix(theta).mT

    def _away(self, theta: Float[Tensor, " p"], changes: Changes) -> Float[Tensor, "N 3"]:
        """The measurement without the offset and the changes at the port "sensor"."""
        away = self.measured
        if "sensor" in changes:
            change = changes["sensor"]
            away = away - change(
                torch.zeros_like(self.measured) if isinstance(change, FreeChange) else self.simulated(theta)
            )
        return away - theta[:3]

    def _field_change(self, changes: Changes) -> Tensor | None:
        """The change at the port "field", (N, channels of the port); None without a change."""
        return changes["field"](self.measured.new_zeros(len(self.measured), 0)) if "field" in changes else None

    def _strength(self, theta: Float[Tensor, " p"]) -> Float[Tensor, ""]:
        """The field strength."""
        return self.measured.new_tensor(self.strength)

    def _ellipsoid(self, rows: Bool[Tensor, " N"] | None) -> EllipsoidFit:
        chosen = thinned(self.thin if rows is None else self.thin & rows)
        # effects may scatter the samples as widely as noise
        ellipsoid = EllipsoidFit(LeastTrimmedSquares(), max_scatter=math.inf)
        if rows is None:
            return ellipsoid.fit(self.measured[chosen])
        try:
            return ellipsoid.fit(self.measured[chosen])
        except ValueError as error:
            raise NoFitError(f"These samples alone do not determine an ellipsoid. {error}") from error


def length_of(vectors: Float[Tensor, "3 N"]) -> Float[Tensor, " N"]:
    """Lengths of column vectors."""
    return vectors.square().sum(0).sqrt()


def thinned(taken: Bool[Tensor, " N"]) -> Int[Tensor, " n"]:
    """Evenly spaced numbers of the samples taken, as many as the start of a fit needs."""
    numbers = torch.nonzero(taken).flatten()
    return numbers[:: max(1, len(numbers) // _ENOUGH)]


def _rests(turns: Tensor | None) -> tuple[str, ...]:
    """A warning if the sensor rests most of the time; else empty."""
    rest = 0.0 if turns is None else 1.0 - float(turns.double().mean())
    if rest <= _MOSTLY:
        return ()
    return (
        f"The sensor rests for {100.0 * rest:.0f} % of the recording. While it rests, a change of its offset shows in "
        "one direction only, or not at all; keep it turning.",
    )
