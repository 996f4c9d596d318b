"""Standard errors of a heading by a calibration: of its changes over a level turn, and of a constant offset."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.calibration.aided.response import Model

if TYPE_CHECKING:
    from jaxtyping import Float

_STEPS = 36
"""Number of headings of the level turn."""


def turning_axis(rate: Float[Tensor, "N 3"]) -> Float[Tensor, " 3"]:
    """The body axis about which the sensor turns most, the vertical of a vehicle, (3,).

    Example:
        >>> turning_axis(torch.tensor([[0.0, 0.1, 1.0], [0.0, -0.1, -1.0], [0.1, 0.0, 1.0]]).double()).abs().round()
        tensor([0., 0., 1.], dtype=torch.float64)
    """
    return torch.linalg.eigh(rate.mT @ rate).eigenvectors[:, -1]


def heading_errors(
    model: Model,
    theta: Float[Tensor, " p"],
    covariance: Float[Tensor, "p p"],
    field: Float[Tensor, "N 3"],
    vertical: Float[Tensor, " 3"],
) -> tuple[float, float]:
    """Standard errors in ° of heading changes over a level turn, and of the mean heading error; to first order.

    Args:
        model: model of the sensor.
        theta: its parameters.
        covariance: covariance of the parameters.
        field: corrected field of the recording, in the body's axes.
        vertical: vertical unit vector in the body's axes.
    """
    up = (field @ vertical).median()
    flat = field - (field @ vertical)[:, None] * vertical
    across = torch.linalg.vector_norm(flat, dim=-1).median()
    first = torch.linalg.svd(vertical[None]).Vh[1]
    second = torch.linalg.cross(vertical, first)
    angle = torch.arange(_STEPS, dtype=field.dtype) * (2.0 * math.pi / _STEPS)
    level = across * (angle.cos()[:, None] * first + angle.sin()[:, None] * second) + up * vertical
    measured = (level @ model.response(theta).mT + theta[:3]).detach()

    def heading(at: Tensor) -> Tensor:
        seen = torch.linalg.solve(model.response(at), (measured - at[:3]).mT).mT
        ahead, aside = seen @ first, seen @ second
        # relative to the true angle, so that no value jumps by 2π
        return torch.atan2(angle.cos() * aside - angle.sin() * ahead, angle.cos() * ahead + angle.sin() * aside)

    with torch.enable_grad():
        slopes = torch.autograd.functional.jacobian(heading, theta)
    mean = slopes.mean(0, keepdim=True)
    spread = [torch.einsum("ip,pq,iq->i", rows, covariance, rows) for rows in (slopes - mean, mean)]
    change, constant = (math.degrees(math.sqrt(max(0.0, float(variance.mean())))) for variance in spread)
    return change, constant
