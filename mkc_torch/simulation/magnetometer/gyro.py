"""A magnetometer compared by the field vector within windows of seconds, rotated by a gyroscope."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.calibration.aided.rotation import gaps, rotated, rotation_since
from mkc_torch.calibration.ellipsoid_fit import EllipsoidFit
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.nonlinear import GaussianPrior
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.magnetometer.matrix import SOFT_IRON
from mkc_torch.simulation.magnetometer.view import AXES, GYRO, INDEPENDENT, VECTOR, View
from mkc_torch.simulation.ports import Changes, Port

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

WINDOW = 2.0
"""Length in s of the windows within which a gyroscope is integrated; each has its own unknown field direction."""

GYRO_BIAS = 0.02
"""Prior standard deviation of a gyroscope's bias in rad/s."""

_REWEIGHTED = 10
"""Number of reweighted least-squares iterations."""

_TURNED = 1e-3
"""Smallest ratio of eigenvalues at which the turns determine the offset."""


class GyroView(View):
    """The field vector, rotated by the gyroscope to the first sample of its window: along the field, and across it.

    The matrix is a general matrix: it also rotates the magnetometer's axes to the gyroscope's, which the length does
    not determine.
    """

    view = "gyro"
    channels = VECTOR
    independent = INDEPENDENT
    parameter_names = (
        *(f"offset_{a}" for a in AXES),
        *(f"matrix_{a}{b}" for a in AXES for b in AXES),
        *(f"gyro_bias_{a}" for a in AXES),
    )

    def __init__(self, recording: Recording) -> None:
        super().__init__(recording)
        self.ports = {
            "sensor": Port(AXES, self.unit, allows_drift=True, pointwise=False),
            "field": Port(("strength",), self.unit, pointwise=False),
        }
        self.prior = _prior()
        self.window, self.first = _windows(self.time)
        self.turned = rotation_since(self.time, recording.stack(*GYRO), self.first)
        self.summed = _summed(self.turned, self.time, self.first)
        self.count = int(self.window.max()) + 1
        try:
            fit = self._ellipsoid(None)
        except NotIdentifiableError as error:
            offset = self._offset_by_turns(error)
            self.strength = float(torch.linalg.vector_norm(self.measured - offset, dim=-1).median())
            self._full = torch.cat([offset, torch.eye(3).to(offset).flatten(), offset.new_zeros(3)])
            self.warnings = (*self.warnings, f"The gyroscope replaces missing turns: {error}")
        else:
            self.strength = float(fit.radius_)
            self._full = self._theta(fit)
        self._unbent = self.matrix(self._full)

    def start(self, rows: Bool[Tensor, " N"] | None = None) -> Tensor:
        return self._full.clone() if rows is None else self._theta(self._ellipsoid(rows))

    def _offset_by_turns(self, error: NotIdentifiableError) -> Tensor:
        """The offset, with matrix 1, that makes the field of each window constant, by reweighted least squares.

        Raises:
            NotIdentifiableError: ``error``, where the turns do not determine the offset either.
        """
        field = rotated(self.measured, self.turned)
        weight = field.new_ones(len(field), 1)
        offset = field.new_zeros(3)
        for _ in range(_REWEIGHTED):
            mean = self._window_mean(field, weight)[self.window]
            turned = self._window_mean(self.turned.flatten(1), weight)[self.window].unflatten(-1, (3, 3))
            regressors, target = (self.turned - turned), field - mean
            gram = torch.einsum("kai,k,kaj->ij", regressors, weight[:, 0], regressors)
            known = torch.linalg.eigvalsh(gram)
            if not bool(known[0] > _TURNED * known[-1]):
                raise error
            offset = torch.linalg.lstsq(
                gram, torch.einsum("kai,k,ka->i", regressors, weight[:, 0], target).unsqueeze(-1)
            ).solution.squeeze(-1)
            distance = torch.linalg.vector_norm(target - regressors @ offset, dim=-1, keepdim=True)
            scale = distance.median().clamp(min=1e-9)
            weight = torch.exp(-0.5 * (distance / (2.0 * scale)).square()).clamp(min=1e-12)
        return offset

    def _theta(self, fit: EllipsoidFit) -> Tensor:
        matrix = fit.calibration_matrix_ * (self.strength / float(fit.radius_))
        return torch.cat([fit.center_, matrix.flatten(), fit.center_.new_zeros(3)])

    def residual(self, theta: Float[Tensor, " p"], changes: Changes) -> Float[Tensor, "N 3"]:
        along = self._steadied(theta, self.corrected(theta, changes))
        middle = self._window_mean(along, self._weights(along.detach()))
        direction = middle / torch.linalg.vector_norm(middle, dim=-1, keepdim=True)
        strength, added = self._strength(theta), self._field_change(changes)
        ambient = (strength if added is None else strength + added) * direction[self.window]
        frame = _frame(direction.detach())[self.window]
        # in units of the measurement: the fitted matrix would shrink the noise; a fixed matrix calibrates the residual
        difference = rotated(along - ambient, self.turned.mT)
        difference = torch.linalg.solve(self.matrix(theta), difference.mT).mT @ self._unbent.mT
        return rotated(rotated(difference, self.turned), frame)

    def _steadied(self, theta: Tensor, field: Tensor) -> Tensor:
        """The calibrated field in the sensor frame of its window's first sample."""
        along = rotated(field, self.turned)
        # a small bias b rotates it by the integral of turned · b since the window's first sample
        return along - torch.linalg.cross(self.summed @ theta[12:15], along)

    def simulated(self, theta: Float[Tensor, " p"]) -> Float[Tensor, "N 3"]:
        along = self._steadied(theta, self.corrected(theta, {}))
        middle = self._window_mean(along, self._weights(along.detach()))
        direction = middle / torch.linalg.vector_norm(middle, dim=-1, keepdim=True)
        field = rotated(self._strength(theta) * direction[self.window], self.turned.mT)
        return torch.linalg.solve(self.matrix(theta), field.mT).mT

    def _window_mean(self, values: Tensor, weight: Tensor) -> Tensor:
        total = values.new_zeros(self.count, values.shape[-1]).index_add(0, self.window, weight * values)
        return total / weight.new_zeros(self.count, 1).index_add(0, self.window, weight)[:, :1]

    def _weights(self, along: Tensor) -> Tensor:
        """Weights of the samples in the mean of their window, constant in the fit: three redescending reweightings."""
        weight = along.new_ones(len(along), 1)
        for cut in (2.0, 1.0, 1.0):
            distance = torch.linalg.vector_norm(
                along - self._window_mean(along, weight)[self.window], dim=-1, keepdim=True
            )
            scale = distance.median() + 1e-9 * self.strength
            weight = 1.0 / torch.clamp(distance / (cut * scale), min=1.0).square()
        return weight


def _frame(direction: Float[Tensor, "W 3"]) -> Float[Tensor, "W 3 3"]:
    """Orthonormal axes as rows, the first along each direction."""
    smallest = torch.nn.functional.one_hot(direction.abs().argmin(-1), 3).to(direction)
    second = torch.linalg.cross(direction, smallest)
    second = second / torch.linalg.vector_norm(second, dim=-1, keepdim=True)
    return torch.stack([direction, second, torch.linalg.cross(direction, second)], -2)


def _windows(time: Tensor) -> tuple[Tensor, Tensor]:
    """The window of each sample, and the first sample of that window; a gap starts a new window."""
    number = torch.floor((time - time[0]) / WINDOW).long()
    number[1:] += gaps(time).cumsum(0)
    _, window, counts = torch.unique_consecutive(number, return_inverse=True, return_counts=True)
    start = torch.cat([counts.new_zeros(1), counts.cumsum(0)[:-1]])
    return window, start[window]


def _prior() -> GaussianPrior:
    """The prior of the matrix about the identity, and of the gyroscope's bias about 0."""
    mean = torch.zeros(15, dtype=torch.float64)
    precision = torch.zeros(15, dtype=torch.float64)
    mean[3:12] = torch.eye(3, dtype=torch.float64).flatten()
    precision[3:12], precision[12:] = SOFT_IRON**-2, GYRO_BIAS**-2
    return GaussianPrior(mean, precision)


def _summed(turned: Tensor, time: Tensor, first: Tensor) -> Tensor:
    """Integral of the rotation over time since the first sample of each window, (N, 3, 3), by trapezoids."""
    step = 0.5 * (turned[1:] + turned[:-1]) * time.diff()[:, None, None]
    total = torch.cat([torch.zeros_like(turned[:1]), step.cumsum(0)])
    # frames differ between windows, but the sum before a window's first sample is subtracted
    return total - total[first]
