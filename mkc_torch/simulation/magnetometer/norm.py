"""A magnetometer compared by the field strength."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.calibration.ellipsoid_fit import EllipsoidFit
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.nonlinear import GaussianPrior
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.magnetometer.matrix import SOFT_IRON, SYMMETRIC
from mkc_torch.simulation.magnetometer.parts import Surface, ellipsoid_of_a_part, sphere_of_all
from mkc_torch.simulation.magnetometer.view import AXES, View, length_of, thinned
from mkc_torch.simulation.ports import Changes, Port

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


class NormView(View):
    """Field strength: one channel, the first-order distance from the ellipsoid, in the measurement's unit.

    If all samples together do not determine an ellipsoid, a part of the recording may: the fit starts from that part,
    and the sensor is fitted together with its change.

    Args:
        recording: the prepared recording.
        sphere: start from the sphere nearest to the samples if no part determines an ellipsoid either but enough
            directions are covered.

    Raises:
        NotIdentifiableError: the turns of the sensor do not determine it from the field strength.
    """

    view = "norm"
    channels = ("norm",)
    independent: tuple[bool, ...] = (True,)
    parameter_names = (*(f"offset_{a}" for a in AXES), *(f"matrix_{AXES[i]}{AXES[j]}" for i, j in SYMMETRIC))
    prior: GaussianPrior | None = None

    def __init__(self, recording: Recording, *, sphere: bool = False) -> None:
        super().__init__(recording)
        self.ports = {"sensor": Port(AXES, self.unit, allows_drift=True), "field": Port(("strength",), self.unit)}
        self.alone = True
        """Whether the field strength determines the sensor without a change of it."""
        try:
            fit = self._ellipsoid(None)
        except NotIdentifiableError as error:
            surface = self._surface_of_part(sphere)
            if surface is None:
                raise
            self.alone = False
            self.strength = surface.radius
            self._full = _numbers(surface.center, surface.matrix)
            self.prior = _near(self._full)
            self.warnings = (*self.warnings, _start_warning(surface, self, error))
        else:
            self.strength = float(fit.radius_)
            self._full = self._theta(fit)

    def start(self, rows: Bool[Tensor, " N"] | None = None) -> Tensor:
        return self._full.clone() if rows is None else self._theta(self._ellipsoid(rows))

    def _surface_of_part(self, sphere: bool) -> Surface | None:
        """The ellipsoid of a part of the recording, else with ``sphere`` the sphere of all samples, else None."""
        chosen = thinned(self.thin)
        found = ellipsoid_of_a_part(self.measured, chosen)
        return sphere_of_all(self.measured, chosen) if found is None and sphere else found

    def _theta(self, fit: EllipsoidFit) -> Tensor:
        return _numbers(fit.center_, fit.calibration_matrix_ * (self.strength / float(fit.radius_)))

    def residual(self, theta: Float[Tensor, " p"], changes: Changes) -> Float[Tensor, "N 1"]:
        length, outward = self._length(theta, self._away(theta, changes).mT)
        distance, added = (length - self._strength(theta)).unsqueeze(-1), self._field_change(changes)
        distance = distance if added is None else distance - added
        return distance * (length / length_of(outward)).unsqueeze(-1)

    def simulated(self, theta: Float[Tensor, " p"]) -> Float[Tensor, "N 3"]:
        away = self._away(theta, {}).mT
        length, outward = self._length(theta, away)
        # a gradient step that brings the length to the field strength, to first order
        return (away - (length - self._strength(theta)) * length * outward / outward.square().sum(0)).mT

    def _length(self, theta: Tensor, away: Float[Tensor, "3 N"]) -> tuple[Float[Tensor, " N"], Float[Tensor, "3 N"]]:
        """Length of the calibrated field, and its gradient by the measurement times the length."""
        matrix = self.matrix(theta)
        field = matrix @ away
        return length_of(field), matrix.mT @ field


def _numbers(center: Float[Tensor, " 3"], matrix: Float[Tensor, "3 3"]) -> Float[Tensor, " 9"]:
    return torch.cat([center, torch.stack([matrix[i, j] for i, j in SYMMETRIC])])


def _near(theta: Float[Tensor, " 9"]) -> GaussianPrior:
    """The prior of the matrix only: without the effects, the samples do not determine it."""
    precision = torch.zeros_like(theta)
    precision[3:] = SOFT_IRON**-2
    return GaussianPrior(theta.clone(), precision)


def _start_warning(surface: Surface, view: View, error: NotIdentifiableError) -> str:
    """A sentence about the start of a fit."""
    if (surface.first, surface.last) == (0, len(view.measured)):
        what = "the sphere nearest to all samples"
    else:
        begin, end = float(view.time[surface.first]), float(view.time[surface.last - 1])
        what = f"the ellipsoid of the samples from {begin:.4g} to {end:.4g} s"
    return (
        f"All samples together do not determine an ellipsoid; offset and matrix start from {what}, and are valid "
        f"together with the change of the sensor. {error}"
    )
