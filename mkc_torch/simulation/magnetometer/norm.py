"""A magnetometer compared by the length of the field."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.calibration.ellipsoid_fit import EllipsoidFit
from mkc_torch.nonlinear import GaussianPrior
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.magnetometer.matrix import SYMMETRIC
from mkc_torch.simulation.magnetometer.view import AXES, View, length_of
from mkc_torch.simulation.protocol import Changes, Port

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["NormView"]


class NormView(View):
    """Length of the field: one channel, the distance from the ellipsoid to first order, in the measurement's units."""

    view = "norm"
    channels = ("norm",)
    independent: tuple[bool, ...] = (True,)
    parameter_names = (
        *(f"offset_{a}" for a in AXES),
        *(f"matrix_{AXES[i]}{AXES[j]}" for i, j in SYMMETRIC),
    )
    prior: GaussianPrior | None = None

    def __init__(self, recording: Recording) -> None:
        super().__init__(recording)
        self.ports = {
            "sensor": Port(AXES, self.unit, wanders=True),
            "field": Port(("strength",), self.unit),
        }
        fit = self._ellipsoid(None)
        self.strength = float(fit.radius_)
        self._full = self._theta(fit)

    def start(self, rows: Bool[Tensor, " N"] | None = None) -> Tensor:
        return self._full.clone() if rows is None else self._theta(self._ellipsoid(rows))

    def _theta(self, fit: EllipsoidFit) -> Tensor:
        matrix = fit.calibration_matrix_ * (self.strength / float(fit.radius_))
        return torch.cat([fit.center_, torch.stack([matrix[i, j] for i, j in SYMMETRIC])])

    def residual(self, theta: Float[Tensor, " p"], changes: Changes) -> Float[Tensor, "N 1"]:
        length, outward = self._length(theta, self._away(theta, changes).mT)
        distance, added = (length - self._strength(theta)).unsqueeze(-1), self._field_change(changes)
        distance = distance if added is None else distance - added
        return distance * (length / length_of(outward)).unsqueeze(-1)

    def simulated(self, theta: Float[Tensor, " p"]) -> Float[Tensor, "N 3"]:
        away = self._away(theta, {}).mT
        length, outward = self._length(theta, away)
        # a step against the steepest ascent of the length, as far as that is off
        return (away - (length - self._strength(theta)) * length * outward / outward.square().sum(0)).mT

    def _length(self, theta: Tensor, away: Float[Tensor, "3 N"]) -> tuple[Float[Tensor, " N"], Float[Tensor, "3 N"]]:
        """Length of the calibrated field, and that times its gradient by the measurement."""
        matrix = self.matrix(theta)
        field = matrix @ away
        return length_of(field), matrix.mT @ field
