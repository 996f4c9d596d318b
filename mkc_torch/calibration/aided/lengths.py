"""What the field of a place makes of turns that nobody recorded: its length, and how far it points down."""

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

__all__ = ["Circle", "LengthModel", "circle"]

LEVEL = 0.035
"""Angle in rad by which the axis of a vehicle's turns is off the vertical: roads and rivers slope by less than 3.5 %
for the most part, and a helm that is held over leans a boat as much."""

_STEEPEST = 0.9999
"""Sine of the angle to the horizon beyond which there is no direction along which the field tilts."""

_ROUNDS = 5


@dataclass(frozen=True)
class Circle:
    """The circle that the measurements of a vehicle draw as it turns about one axis.

    Attributes:
        axis: (3,), of the turns, in the axes of the sensor, either sign.
        center: (3,), in the plane in which most of the samples lie.
        radius: in the unit of the measurement.
    """

    axis: Float[Tensor, " 3"]
    center: Float[Tensor, " 3"]
    radius: float


@dataclass(frozen=True)
class LengthModel(Model):
    """A sensor whose field has the length of the place's, and which turns about an axis that is vertical.

    A length does not tell how the sensor is turned in the vehicle: the response is symmetric. A last parameter is the
    angle in rad by which the axis is not vertical.

    Attributes:
        circle: that the measurements draw.
        rises: angle in rad by which the field points along the circle's axis, of the sign that is tried.
        rises_error: its standard deviation.
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
        """Parameters at an offset and near a response, about a vertical axis."""
        return torch.cat([super().start(offset, response), offset.new_zeros(1)])

    def prior(self, place: PlaceField | None = None, errors: Float[Tensor, " 12"] | None = None) -> GaussianPrior:
        """As of any response, and an axis that is nearly vertical."""
        known = super().prior(place, errors)
        precision = known.precision.clone()
        precision[-1, -1] = self.rises_error**-2
        return GaussianPrior(known.mean, precision)

    def residual(
        self, theta: Float[Tensor, " p"], measured: Float[Tensor, "N 3"], *_: Turns | Tensor
    ) -> Float[Tensor, "N 2"]:
        """Distances of each measurement from the ellipsoid and, on it, from the circle that is drawn without tilts.

        In the unit of the measurement and to first order. The two are at right angles: together they are as likely on
        either side of the circle where nothing tilts, and the first alone would not be.

        References:
            Sampson, "Fitting conic sections to 'very scattered' data", Computer Graphics and Image Processing 18
            (1982): what is off in length would be made small by a large response.
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
        """One for each: no direction is taken from the samples."""
        return measured.new_ones(len(measured))


def circle(measured: Float[Tensor, "N 3"]) -> Circle:
    """The circle nearest to most of the measurements.

    Args:
        measured: of a sensor that turned about one axis for the most part, in any unit.

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
    fit = MKCRegression().fit(torch.cat([2.0 * flat, flat.new_ones(len(flat), 1)], -1), flat.square().sum(-1))
    at = fit.coef_[:2]
    radius = math.sqrt(max(float(fit.coef_[2] + at @ at), 0.0))
    return Circle(axes[:, 0], middle + size * axes[:, 1:] @ at, size * radius)
