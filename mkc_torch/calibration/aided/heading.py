"""How well a heading is known by a calibration: how it changes over a level turn, and a constant."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.calibration.aided.response import Model

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["heading_errors", "turning_axis"]

_STEPS = 36


def turning_axis(rate: Float[Tensor, "N 3"]) -> Float[Tensor, " 3"]:
    """The axis of the body about which it turns for the most part, which is a vehicle's vertical.

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
    """Standard errors in ° of the heading over a whole level turn, less its mean, and of that mean; to first order.

    Args:
        model: of the sensor.
        theta: its parameters.
        covariance: of their errors.
        field: corrected, of the recording, in the body's axes.
        vertical: in the body's axes, a unit vector.
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
        # from the angle that it is, so that none jumps by a turn
        return torch.atan2(angle.cos() * aside - angle.sin() * ahead, angle.cos() * ahead + angle.sin() * aside)

    with torch.enable_grad():
        slopes = torch.autograd.functional.jacobian(heading, theta)
    mean = slopes.mean(0, keepdim=True)
    spread = [torch.einsum("ip,pq,iq->i", rows, covariance, rows) for rows in (slopes - mean, mean)]
    change, constant = (math.degrees(math.sqrt(max(0.0, float(one.mean())))) for one in spread)
    return change, constant
