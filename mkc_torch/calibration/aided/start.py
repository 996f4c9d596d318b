"""A robust offset to start from: the one that leaves the field of each stretch steady."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.calibration.aided.turns import Turns

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["offset_by_turns"]

_ABSOLUTE, _REWEIGHTED = 15, 15
"""Steps of least absolute distances, and then of Welsch's estimator, which forgets what is far."""

_PULL = 1e-4
"""Towards no offset, of what moves it most: enough where nothing turns, and nothing where something does."""


def offset_by_turns(measured: Float[Tensor, "N 3"], turns: Turns) -> tuple[Float[Tensor, " 3"], float, float]:
    """Offset, length of the field, and what is left, of a sensor whose response is a multiple of the identity.

    A field that turns with the body, less the offset, stands still once it is turned back: linear equations for the
    offset. Where the sensor turns about one axis alone, the offset along it shows nowhere, and is taken for 0.

    Args:
        measured: in any unit.
        turns: of the body.

    Returns:
        Offset, length of the field without it, and by how much half of the samples are off a field that stands still,
        in the unit of the measurement.

    References:
        Kok & Schön, "Magnetometer calibration using inertial sensors", IEEE Sensors Journal 16 (2016), use the same
        property; the equations are those of the integrated dm/dt = -ω × (m - offset).
    """
    turned = turns.to_frame
    seen = (turned @ measured.unsqueeze(-1)).squeeze(-1)
    size = float(torch.linalg.vector_norm(measured, dim=-1).median()) or 1.0
    weight = measured.new_ones(len(measured), 1)
    offset = measured.new_zeros(3)
    left = measured.new_zeros(1)
    for step in range(_ABSOLUTE + _REWEIGHTED):
        target = seen - _mean(seen, weight, turns)
        by = turned - _mean(turned.flatten(1), weight, turns).unflatten(-1, (3, 3))
        gram = torch.einsum("kai,k,kaj->ij", by, weight[:, 0], by)
        moment = torch.einsum("kai,k,ka->i", by, weight[:, 0], target)
        pull = _PULL * torch.linalg.eigvalsh(gram)[-1].clamp(min=1e-12 * len(seen)) * torch.eye(3, dtype=gram.dtype)
        offset = torch.linalg.solve(gram + pull, moment)
        left = torch.linalg.vector_norm(target - by @ offset, dim=-1, keepdim=True)
        if step < _ABSOLUTE:
            weight = 1.0 / left.clamp(min=1e-3 * size)
        else:
            scale = 2.0 * left.median().clamp(min=1e-9 * size)
            weight = torch.exp(-0.5 * (left / scale).square()).clamp(min=1e-9)
    return offset, float(torch.linalg.vector_norm(measured - offset, dim=-1).median()), float(left.median())


def _mean(values: Tensor, weight: Tensor, turns: Turns) -> Tensor:
    """Of each sample's stretch."""
    total = values.new_zeros(turns.count, values.shape[-1]).index_add(0, turns.window, weight * values)
    return (total / weight.new_zeros(turns.count, 1).index_add(0, turns.window, weight))[turns.window]
