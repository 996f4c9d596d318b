"""A magnetometer whose turns were not recorded: its fit uses length and inclination of the field at a known place."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.calibration.aided.response import Model, PlaceField
from mkc_torch.calibration.aided.turns import Turns
from mkc_torch.linear import MKCRegression
from mkc_torch.nonlinear import GaussianPrior

if TYPE_CHECKING:
    from jaxtyping import Float

LEVEL = 0.035
"""Standard deviation of the angle between the axis of a vehicle's turns and the vertical, in rad: roads and rivers
mostly slope by less than 3.5 %, and a boat leans as much in a turn."""

_STEEPEST = 0.9999
"""Largest sine of the field's angle to the plane of the circle, which keeps the direction of tilting defined."""

_ROUNDS = 5
"""Iterations of the reweighted plane fit."""


@dataclass(frozen=True)
class Circle:
    """The circle of a vehicle's measurements as it turns about an axis.

    Attributes:
        axis: axis of the turns in the axes of the sensor, (3,), of either sign.
        center: centre, (3,), in the plane of most samples.
        radius: radius in the unit of the measurement.
    """

    axis: Float[Tensor, " 3"]
    center: Float[Tensor, " 3"]
    radius: float


@dataclass(frozen=True)
class LengthModel(Model):
    """A sensor in a field of known length that turns about a nearly vertical axis.

    Lengths do not determine the mounting of the sensor, so the response is symmetric. The last parameter is the angle
    in rad between the axis and the vertical.

    Attributes:
        circle: circle of the measurements.
        rises: angle of the field above the plane of the circle, in rad, of the assumed sign.
        rises_error: standard deviation of ``rises``, in rad.
    """

    circle: Circle
    rises: float
    rises_error: float

    @property
    def entries(self) -> Float[Tensor, "9 k"]:
        whole = super().entries
        if whole.shape[1] < 9:
            return whole
        pairs = [(i, j) for i in range(3) for j in range(i, 3)]
        columns = torch.stack([whole[:, 3 * i + j] + whole[:, 3 * j + i] for i, j in pairs], -1)
        return columns / torch.linalg.vector_norm(columns, dim=0)

    @property
    def size(self) -> int:
        return super().size + 1

    def start(self, offset: Float[Tensor, " 3"], response: Float[Tensor, "3 3"]) -> Float[Tensor, " p"]:
        """Starting parameters for an offset and a response, with a vertical axis."""
        return torch.cat([super().start(offset, response), offset.new_zeros(1)])

    def prior(self, place: PlaceField | None = None, errors: Float[Tensor, " 12"] | None = None) -> GaussianPrior:
        """The prior of :meth:`Model.prior`, and of a nearly vertical axis."""
        known = super().prior(place, errors)
        precision = known.precision.clone()
        precision[-1, -1] = self.rises_error**-2
        return GaussianPrior(known.mean, precision)

    def residual(
        self, theta: Float[Tensor, " p"], measured: Float[Tensor, "N 3"], *_: Turns | Tensor
    ) -> Float[Tensor, "N 2"]:
        """Distance of each measurement from the ellipsoid and, along it, from the circle of an untilted turn.

        In the unit of the measurement, to first order. The two distances are orthogonal: without tilts, the likelihood
        is equal on either side of the circle, which the first distance alone would not ensure.

        References:
            Sampson, "Fitting conic sections to 'very scattered' data", Computer Graphics and Image Processing 18
            (1982): without the division by the slope, a large response would make length errors small.
        """
        response = self.response(theta)
        inverse = torch.linalg.inv(response)
        field = (measured - theta[:3]) @ inverse.mT
        length = torch.linalg.vector_norm(field, dim=-1, keepdim=True)
        direction = field / length
        slope = torch.linalg.vector_norm(direction @ inverse, dim=-1, keepdim=True)
        axis = response.mT @ self.circle.axis
        axis = axis / torch.linalg.vector_norm(axis)
        sine = (direction @ axis).unsqueeze(-1).clamp(-_STEEPEST, _STEEPEST)
        upwards = (axis - sine * direction) / (1.0 - sine.square()).sqrt()
        tilt = torch.asin(sine) - self.rises - theta[-1]
        along = tilt * torch.linalg.vector_norm(upwards @ response.mT, dim=-1, keepdim=True)
        return torch.cat([(length - 1.0) / slope, along], -1)

    def first_weight(self, _: Float[Tensor, " p"], measured: Float[Tensor, "N 3"], *__: Turns) -> Float[Tensor, " N"]:
        """Weight 1 for each sample: the model does not average directions."""
        return measured.new_ones(len(measured))


def circle(measured: Float[Tensor, "N 3"]) -> Circle:
    """Fit a circle to measurements robustly.

    Args:
        measured: measurements of a sensor that mostly turned about a single axis, in any unit.

    Example:
        >>> angle = torch.linspace(0.0, 6.0, 90, dtype=torch.float64)
        >>> found = circle(torch.stack([3.0 * angle.cos() + 1.0, 3.0 * angle.sin() - 2.0, 0.0 * angle + 5.0], -1))
        >>> (
        ...     [round(v, 6) + 0.0 for v in found.center.tolist()],
        ...     round(found.radius, 6),
        ...     found.axis.abs().round().tolist(),
        ... )
        ([1.0, -2.0, 5.0], 3.0, [0.0, 0.0, 1.0])
    """
    middle = measured.median(0).values
    weight = measured.new_ones(len(measured), 1)
    axes = torch.eye(3, dtype=measured.dtype)
    for _ in range(_ROUNDS):
        middle = (weight * measured).sum(0) / weight.sum()
        centred = measured - middle
        axes = torch.linalg.eigh(centred.mT @ (weight * centred)).eigenvectors
        off = (centred @ axes[:, :1]).abs()
        weight = 1.0 / (1.0 + (off / (2.0 * off.median() + 1e-9 * centred.abs().max())).square()).square()
    flat = (measured - middle) @ axes[:, 1:]
    size = float(flat.abs().median()) or 1.0
    flat = flat / size
    columns = torch.cat([2.0 * flat, flat.new_ones(len(flat), 1)], -1)
    fit = MKCRegression().fit(columns.unsqueeze(-2), flat.square().sum(-1, keepdim=True))
    at = fit.coef_[:2]
    radius = math.sqrt(max(float(fit.coef_[2] + at @ at), 0.0))
    return Circle(axes[:, 0], middle + size * axes[:, 1:] @ at, size * radius)
