"""Residual of a measured field under recorded turns, robust against slow changes of the sensor's offset."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale

if TYPE_CHECKING:
    from jaxtyping import Float, Int

STRETCH = 20.0
"""Length in s of a stretch with its own offset, so that changes of the sensor's offset do not count as misfit."""

_REWEIGHTED = 8
"""Iterations of the reweighted least squares fit."""

_RIDGE = 1e-6
"""Relative regularisation of offsets that the turns do not determine."""


def robust_size(residual: Float[Tensor, "N m"]) -> float:
    """Root mean square over the channels of their robust scales, the typical residual of an axis.

    Example:
        >>> robust_size(torch.tensor([[1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]]))
        1.482...
    """
    return float(robust_scale(residual).square().mean().sqrt())


def stretches(time: Float[Tensor, " N"]) -> Int[Tensor, " N"]:
    """Index of each sample's stretch of 20 s, without skipped numbers, (N,).

    Example:
        >>> stretches(torch.tensor([0.0, 19.0, 21.0, 70.0]))
        tensor([0, 0, 1, 2])
    """
    number = torch.floor((time - time[0]) / STRETCH).long()
    return torch.unique_consecutive(number, return_inverse=True)[1]


def misfit_of_gyroscope(
    field: Float[Tensor, "N 3"], turned: Float[Tensor, "N 3 3"], window: Int[Tensor, " N"], stretch: Int[Tensor, " N"]
) -> float:
    """Size of the residual of a field that is constant within each window once rotated, in the field's unit.

    Robust linear regression of ``turned @ (field - offset)`` on an unknown vector for each window, with an offset for
    each stretch.

    Args:
        field: measured field with any constant offset, corrected for gains.
        turned: rotations from the body at each sample to axes that are fixed within its window.
        window: index of each sample's window, ascending.
        stretch: index of each sample's stretch, ascending; a window lies within a stretch, or nearly.

    Example:
        >>> angle = torch.linspace(0.0, 6.0, 60).double()
        >>> cos, sin, o = angle.cos(), angle.sin(), torch.zeros(60).double()
        >>> turned = torch.stack([cos, -sin, o, sin, cos, o, o, o, o + 1.0], -1).unflatten(-1, (3, 3))
        >>> field = turned.mT @ torch.tensor([3.0, 4.0, 5.0]).double() + 7.0
        >>> same = torch.zeros(60, dtype=torch.long)
        >>> right, wrong = (round(misfit_of_gyroscope(field, t, same, same), 2) for t in (turned, turned.mT))
        >>> right, wrong > 1.0
        (0.0, True)
    """
    seen = (turned @ field.unsqueeze(-1)).squeeze(-1)
    weight = field.new_ones(len(field), 1)
    residual = seen
    for _ in range(_REWEIGHTED):
        target = seen - _mean(seen, weight, window)[window]
        by = turned - _mean(turned.flatten(1), weight, window)[window].unflatten(-1, (3, 3))
        offset = _solved(by, target, weight, stretch)[stretch]
        residual = target - (by @ offset.unsqueeze(-1)).squeeze(-1)
        weight = _weights(residual)
    return robust_size(residual)


def misfit_of_attitude(
    field: Float[Tensor, "N 3"], to_world: Float[Tensor, "N 3 3"], stretch: Int[Tensor, " N"]
) -> float:
    """Size of the residual of a field that is constant in the world frame, in the field's unit.

    Robust linear regression of the field on an unknown vector in the world frame, with an offset for each stretch.

    Args:
        field: measured field with any constant offset, corrected for gains.
        to_world: rotations from the body to the world frame.
        stretch: index of each sample's stretch, ascending.
    """
    to_body = to_world.mT
    weight = field.new_ones(len(field), 1)
    everywhere = torch.zeros_like(stretch)
    residual = field
    for _ in range(_REWEIGHTED):
        target = field - _mean(field, weight, stretch)[stretch]
        by = to_body - _mean(to_body.flatten(1), weight, stretch)[stretch].unflatten(-1, (3, 3))
        field_in_world_frame = _solved(by, target, weight, everywhere)[0]
        residual = target - by @ field_in_world_frame
        weight = _weights(residual)
    return robust_size(residual)


def _mean(values: Tensor, weight: Tensor, group: Tensor) -> Tensor:
    """Weighted mean of each group, (G, k)."""
    count = int(group.max()) + 1
    total = values.new_zeros(count, values.shape[-1]).index_add(0, group, weight * values)
    return total / weight.new_zeros(count, 1).index_add(0, group, weight)


def _solved(by: Tensor, target: Tensor, weight: Tensor, group: Tensor) -> Tensor:
    """Coefficients of each group by weighted least squares, (G, 3); near 0 where nothing turns."""
    count = int(group.max()) + 1
    weighed = weight.unsqueeze(-1) * by
    gram = by.new_zeros(count, 3, 3).index_add(0, group, weighed.mT @ by)
    moment = by.new_zeros(count, 3).index_add(0, group, (weighed.mT @ target.unsqueeze(-1)).squeeze(-1))
    samples = by.new_zeros(count).index_add(0, group, weight[:, 0])
    ridge = _RIDGE * samples[:, None, None] * torch.eye(3, dtype=by.dtype)
    return torch.linalg.solve(gram + ridge, moment)


def _weights(residual: Tensor) -> Tensor:
    """Welsch weights with a scale of twice the median distance, bounded away from 0, (N, 1)."""
    distance = torch.linalg.vector_norm(residual, dim=-1, keepdim=True)
    scale = 2.0 * distance.median().clamp(min=1e-12)
    return torch.exp(-0.5 * (distance / scale).square()).clamp(min=1e-9)
