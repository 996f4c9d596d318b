"""What recorded turns leave of a measured field, whatever slowly changes the sensor's offset meanwhile."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale

if TYPE_CHECKING:
    from jaxtyping import Float, Int

__all__ = ["left_by_attitude", "left_by_gyroscope", "robust_size", "stretches"]

STRETCH = 20.0
"""Length in s of what has an offset of its own: a step of the sensor's offset is no fault of the turns."""

_REWEIGHTED = 8
_RIDGE = 1e-6


def robust_size(residual: Float[Tensor, "N m"]) -> float:
    """Root of the mean square, over the channels, of their robust scales: what an axis is off by, typically.

    Example:
        >>> robust_size(torch.tensor([[1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]]))
        1.482...
    """
    return float(robust_scale(residual).square().mean().sqrt())


def stretches(time: Float[Tensor, " N"]) -> Int[Tensor, " N"]:
    """The number of each sample's stretch of 20 s, without holes.

    Example:
        >>> stretches(torch.tensor([0.0, 19.0, 21.0, 70.0]))
        tensor([0, 0, 1, 2])
    """
    number = torch.floor((time - time[0]) / STRETCH).long()
    return torch.unique_consecutive(number, return_inverse=True)[1]


def left_by_gyroscope(
    field: Float[Tensor, "N 3"], turned: Float[Tensor, "N 3 3"], window: Int[Tensor, " N"], stretch: Int[Tensor, " N"]
) -> float:
    """Size of what is left of a field that is steady within each window, once turned, in the field's unit.

    Robust linear regression of ``turned @ (field - offset)`` on one unknown vector a window; the offset is one a
    stretch.

    Args:
        field: measured, of any constant offset; its gains corrected.
        turned: from the body at each sample into axes that are fixed within its window.
        window: number of each sample's window, ascending.
        stretch: number of each sample's stretch, ascending; a window lies in one, or nearly.

    Example:
        >>> angle = torch.linspace(0.0, 6.0, 60).double()
        >>> cos, sin, o = angle.cos(), angle.sin(), torch.zeros(60).double()
        >>> turned = torch.stack([cos, -sin, o, sin, cos, o, o, o, o + 1.0], -1).unflatten(-1, (3, 3))
        >>> field = turned.mT @ torch.tensor([3.0, 4.0, 5.0]).double() + 7.0
        >>> one = torch.zeros(60, dtype=torch.long)
        >>> right, wrong = (round(left_by_gyroscope(field, t, one, one), 2) for t in (turned, turned.mT))
        >>> right, wrong > 1.0
        (0.0, True)
    """
    seen = (turned @ field.unsqueeze(-1)).squeeze(-1)
    weight = field.new_ones(len(field), 1)
    left = seen
    for _ in range(_REWEIGHTED):
        target = seen - _mean(seen, weight, window)[window]
        by = turned - _mean(turned.flatten(1), weight, window)[window].unflatten(-1, (3, 3))
        offset = _solved(by, target, weight, stretch)[stretch]
        left = target - (by @ offset.unsqueeze(-1)).squeeze(-1)
        weight = _weights(left)
    return robust_size(left)


def left_by_attitude(
    field: Float[Tensor, "N 3"], to_world: Float[Tensor, "N 3 3"], stretch: Int[Tensor, " N"]
) -> float:
    """Size of what is left of a field that is steady in the world, in the field's unit.

    Robust linear regression of the field on one unknown vector of the world; the offset is one a stretch.

    Args:
        field: measured, of any constant offset; its gains corrected.
        to_world: rotations from the body to the world.
        stretch: number of each sample's stretch, ascending.
    """
    to_body = to_world.mT
    weight = field.new_ones(len(field), 1)
    everywhere = torch.zeros_like(stretch)
    left = field
    for _ in range(_REWEIGHTED):
        target = field - _mean(field, weight, stretch)[stretch]
        by = to_body - _mean(to_body.flatten(1), weight, stretch)[stretch].unflatten(-1, (3, 3))
        world = _solved(by, target, weight, everywhere)[0]
        left = target - by @ world
        weight = _weights(left)
    return robust_size(left)


def _mean(values: Tensor, weight: Tensor, group: Tensor) -> Tensor:
    """Of each group."""
    count = int(group.max()) + 1
    total = values.new_zeros(count, values.shape[-1]).index_add(0, group, weight * values)
    return total / weight.new_zeros(count, 1).index_add(0, group, weight)


def _solved(by: Tensor, target: Tensor, weight: Tensor, group: Tensor) -> Tensor:
    """Coefficients of each group, (G, 3), by weighted least squares; where nothing turns, next to none."""
    count = int(group.max()) + 1
    weighed = weight.unsqueeze(-1) * by
    gram = by.new_zeros(count, 3, 3).index_add(0, group, weighed.mT @ by)
    moment = by.new_zeros(count, 3).index_add(0, group, (weighed.mT @ target.unsqueeze(-1)).squeeze(-1))
    samples = by.new_zeros(count).index_add(0, group, weight[:, 0])
    pull = _RIDGE * samples[:, None, None] * torch.eye(3, dtype=by.dtype)
    return torch.linalg.solve(gram + pull, moment)


def _weights(left: Tensor) -> Tensor:
    """Welsch's, at twice the median distance, and never 0."""
    distance = torch.linalg.vector_norm(left, dim=-1, keepdim=True)
    scale = 2.0 * distance.median().clamp(min=1e-12)
    return torch.exp(-0.5 * (distance / scale).square()).clamp(min=1e-9)
