"""Estimate a robust starting offset that makes the field of each window constant."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.calibration.aided.turns import Turns

if TYPE_CHECKING:
    from jaxtyping import Float

_ABSOLUTE = 15
"""Iterations of least absolute distances."""

_REWEIGHTED = 15
"""Iterations of Welsch's redescending estimator that follow."""

_RIDGE = 1e-4
"""Relative regularisation towards zero offset, which only matters along directions that the turns do not determine."""


def offset_by_turns(measured: Float[Tensor, "N 3"], turns: Turns) -> tuple[Float[Tensor, " 3"], float, float]:
    """Estimate offset, field length and residual of a sensor whose response is a multiple of the identity.

    The measured field minus the offset is constant once it is rotated back, which gives linear equations for the
    offset. If the sensor only turns about a single axis, the offset along that axis is undetermined and set to 0.

    Returns:
        Offset (3,), length of the field, and median residual of a constant field, in the unit of the measurement.

    References:
        Kok & Schön, "Magnetometer calibration using inertial sensors", IEEE Sensors Journal 16 (2016), use the same
        property; the equations are those of the integrated dm/dt = -ω × (m - offset).
    """
    turned = turns.to_frame
    seen = (turned @ measured.unsqueeze(-1)).squeeze(-1)
    size = float(torch.linalg.vector_norm(measured, dim=-1).median()) or 1.0
    weight = measured.new_ones(len(measured), 1)
    offset = measured.new_zeros(3)
    residual = measured.new_zeros(1)
    for step in range(_ABSOLUTE + _REWEIGHTED):
        target = seen - _mean(seen, weight, turns)
        by = turned - _mean(turned.flatten(1), weight, turns).unflatten(-1, (3, 3))
        gram = torch.einsum("kai,k,kaj->ij", by, weight[:, 0], by)
        moment = torch.einsum("kai,k,ka->i", by, weight[:, 0], target)
        ridge = _RIDGE * torch.linalg.eigvalsh(gram)[-1].clamp(min=1e-12 * len(seen)) * torch.eye(3, dtype=gram.dtype)
        offset = torch.linalg.solve(gram + ridge, moment)
        residual = torch.linalg.vector_norm(target - by @ offset, dim=-1, keepdim=True)
        if step < _ABSOLUTE:
            weight = 1.0 / residual.clamp(min=1e-3 * size)
        else:
            scale = 2.0 * residual.median().clamp(min=1e-9 * size)
            weight = torch.exp(-0.5 * (residual / scale).square()).clamp(min=1e-9)
    return offset, float(torch.linalg.vector_norm(measured - offset, dim=-1).median()), float(residual.median())


def _mean(values: Tensor, weight: Tensor, turns: Turns) -> Tensor:
    """Weighted mean of each sample's window, (N, k)."""
    total = values.new_zeros(turns.count, values.shape[-1]).index_add(0, turns.window, weight * values)
    return (total / weight.new_zeros(turns.count, 1).index_add(0, turns.window, weight))[turns.window]
