"""Models of a sensor that turns in a constant field: offset, and a response of 1, 3 or 9 parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from mkc_torch.calibration.aided.turns import Turns
from mkc_torch.nonlinear import GaussianPrior

if TYPE_CHECKING:
    from jaxtyping import Float

ModelName = Literal["offset", "offset and scale", "full matrix"]

SOFT_IRON = 0.1
"""Prior standard deviation of the deviation of the response from the unit matrix, by soft iron, gains and
misalignment."""

OFFSET = 1.0
"""Prior standard deviation of the offset, in lengths of the field; hard iron on a vehicle is seldom more."""

_FREE = 1e-8
"""Prior precision of free parameters, which keeps the precision matrix positive despite rounding."""

GYRO_BIAS = 0.02
"""Prior standard deviation of a gyroscope's bias, in rad/s."""

GYRO_GAIN = 0.01
"""Prior standard deviation of a gyroscope's relative gain errors and of its axis angles in rad."""

ERRORS = 12
"""Number of error parameters of a gyroscope: bias (3), gains and axes (9)."""


@dataclass(frozen=True)
class PlaceField:
    """Prior of the field at a place, in the unit of the measurement.

    Attributes:
        strength: length of the field.
        inclination: angle below the horizon in rad.
        strength_error, inclination_error: their standard deviations, by the model and local anomalies.
    """

    strength: float
    inclination: float
    strength_error: float
    inclination_error: float


@dataclass(frozen=True)
class Model:
    """``measured = offset + response @ direction``, with the direction of the field in the body's axes.

    Parameters are the offset (3), the response over ``scale`` (1, 3 or 9), and with a gyroscope its bias (3) and the
    errors of its gains and axes (9). Offset and residual are in the unit of the measurement.

    Attributes:
        name: the free part of the response: a multiple of the identity, its diagonal, or the full matrix.
        scale: approximate length of the field in the unit of the measurement.
        biased: True with a gyroscope.
    """

    name: ModelName
    scale: float
    biased: bool

    @property
    def entries(self) -> Float[Tensor, "9 k"]:
        """Linear map from the parameters of the response to its entries, with columns of length 1."""
        eye = torch.eye(9, dtype=torch.float64)
        diagonal = eye[:, [0, 4, 8]]
        return {"offset": diagonal.sum(-1, keepdim=True) / 3.0**0.5, "offset and scale": diagonal, "full matrix": eye}[
            self.name
        ]

    @property
    def size(self) -> int:
        """Number of parameters."""
        return 3 + self.entries.shape[1] + (ERRORS if self.biased else 0)

    def response(self, theta: Float[Tensor, " p"]) -> Float[Tensor, "3 3"]:
        """The response matrix in the unit of the measurement."""
        entries = self.scale * self.entries.to(theta)
        return (entries @ theta[3 : 3 + entries.shape[1]]).unflatten(0, (3, 3))

    def start(self, offset: Float[Tensor, " 3"], response: Float[Tensor, "3 3"]) -> Float[Tensor, " p"]:
        """Starting parameters for an offset and the nearest response, without gyroscope errors."""
        entries = self.entries
        found = torch.linalg.lstsq(entries, response.flatten()[:, None] / self.scale).solution[:, 0]
        return torch.cat([offset, found, offset.new_zeros(ERRORS if self.biased else 0)])

    def prior(self, place: PlaceField | None = None, errors: Float[Tensor, " 12"] | None = None) -> GaussianPrior:
        """Prior of a response near a multiple of the identity, with offset and gyroscope errors near zero.

        Args:
            place: prior of the field; without it the length of the field, the mean of the diagonal, is free.
            errors: errors for which the rates are corrected already; the parameters are the remaining errors.
        """
        count, entries = self.entries.shape[1], self.entries
        precision = torch.zeros(self.size, self.size, dtype=torch.float64)
        mean = torch.zeros(self.size, dtype=torch.float64)
        mean[3 : 3 + count] = torch.linalg.lstsq(entries, torch.eye(3).double().flatten()[:, None]).solution[:, 0]
        identity = torch.eye(3, dtype=torch.float64).flatten() / 3.0**0.5
        along = torch.outer(identity, identity)
        shape = (torch.eye(9, dtype=torch.float64) - along) / SOFT_IRON**2
        if place is not None:
            mean[3 : 3 + count] *= place.strength / self.scale
            # the mean gain has a third of the variance of a gain, plus that of the field's length
            spread = (SOFT_IRON**2 / 3.0 + (place.strength_error / place.strength) ** 2) * 3.0
            shape = shape + along / spread
        precision[3 : 3 + count, 3 : 3 + count] = entries.mT @ shape @ entries + _FREE * torch.eye(count)
        precision[:3, :3] = torch.eye(3) / (OFFSET * self.scale) ** 2
        if self.biased:
            spreads = torch.tensor([GYRO_BIAS] * 3 + [GYRO_GAIN] * 9, dtype=torch.float64)
            precision[-ERRORS:, -ERRORS:] = torch.diag(spreads**-2)
            mean[-ERRORS:] = 0.0 if errors is None else -errors
        return GaussianPrior(mean, precision)

    def residual(
        self, theta: Float[Tensor, " p"], measured: Float[Tensor, "N 3"], turns: Turns, weight: Float[Tensor, " N"]
    ) -> Float[Tensor, "N 3"]:
        """Residual of the measurement in its unit, (N, 3).

        Args:
            theta: the parameters.
            measured: measurement of each sample.
            turns: turns of the samples.
            weight: weight of each sample in the mean direction of its window; constant, so that derivatives are exact.
        """
        response = self.response(theta)
        # use the mean field of each window: the noise of a single sample would shrink the response
        along, turned = self._along(theta, measured, turns)
        direction = steady(along, turns, weight)
        direction = (direction / torch.linalg.vector_norm(direction, dim=-1, keepdim=True))[turns.window]
        if turned is not None:
            direction = direction + torch.linalg.cross(turned, direction)
        body = (turns.to_frame.mT @ direction.unsqueeze(-1)).squeeze(-1)
        return measured - theta[:3] - body @ response.mT

    def first_weight(
        self, theta: Float[Tensor, " p"], measured: Float[Tensor, "N 3"], turns: Turns
    ) -> Float[Tensor, " N"]:
        """Initial weights of the samples, by their distance from the robust mean field of their window, (N,)."""
        along, _ = self._along(theta, measured, turns)
        weight = along.new_ones(len(along))
        for cut in (2.0, 1.0, 1.0, 1.0):
            distance = torch.linalg.vector_norm(along - steady(along, turns, weight)[turns.window], dim=-1)
            weight = 1.0 / torch.clamp(distance / (cut * (distance.median() + 1e-9)), min=1.0).square()
        return weight

    def _along(self, theta: Tensor, measured: Tensor, turns: Turns) -> tuple[Tensor, Tensor | None]:
        """The unit field in the axes of its window, and the rotation in rad by errors of the rates."""
        field = torch.linalg.solve(self.response(theta), (measured - theta[:3]).mT).mT
        along = (turns.to_frame @ field.unsqueeze(-1)).squeeze(-1)
        if turns.summed is None:
            return along, None
        # a small error of the rates rotates the integrated attitude by its integral
        turned = turns.summed @ theta[-ERRORS:]
        return along - torch.linalg.cross(turned, along), turned


def steady(along: Float[Tensor, "N 3"], turns: Turns, weight: Float[Tensor, " N"]) -> Float[Tensor, "W 3"]:
    """The weighted mean of each window, (W, 3)."""
    share = weight.unsqueeze(-1)
    total = share.new_zeros(turns.count, 1).index_add(0, turns.window, share)
    part = share / total[turns.window]
    return along.new_zeros(turns.count, 3).index_add(0, turns.window, part * along)
