"""How well a heading is known by a calibration: how it changes with the turns, and a constant."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["heading_errors", "turning_axis"]

_DRAWS, _ROWS = 200, 300


def turning_axis(rate: Float[Tensor, "N 3"]) -> Float[Tensor, " 3"]:
    """The axis of the body about which it turns for the most part, which is a vehicle's vertical.

    Example:
        >>> turning_axis(torch.tensor([[0.0, 0.1, 1.0], [0.0, -0.1, -1.0], [0.1, 0.0, 1.0]]).double()).abs().round()
        tensor([0., 0., 1.], dtype=torch.float64)
    """
    return torch.linalg.eigh(rate.mT @ rate).eigenvectors[:, -1]


def heading_errors(
    theta: Float[Tensor, " p"],
    covariance: Float[Tensor, "p p"],
    field_of: Callable[[Tensor], Tensor],
    vertical: Float[Tensor, " 3"] | Float[Tensor, "N 3"],
) -> tuple[float, float]:
    """Standard errors in ° of the heading less its mean over the samples, and of that mean.

    Args:
        theta: parameters.
        covariance: of their errors.
        field_of: the corrected field (N, 3) by parameters.
        vertical: in the body's axes, a unit vector, one or of each sample.
    """
    draws = torch.Generator().manual_seed(0)
    values, vectors = torch.linalg.eigh(covariance)
    root = vectors * values.clamp(min=0.0).sqrt()
    level = _level(field_of(theta), vertical)
    changes = []
    for _ in range(_DRAWS):
        drawn = theta + root @ torch.randn(len(theta), generator=draws, dtype=theta.dtype)
        other = _level(field_of(drawn), vertical)
        cross = (torch.linalg.cross(level, other) * vertical).sum(-1)
        changes.append(torch.atan2(cross, (level * other).sum(-1)))
    turned = torch.rad2deg(torch.stack(changes))
    mean = turned.mean(-1, keepdim=True)
    return float((turned - mean).square().mean().sqrt()), float(mean.square().mean().sqrt())


def _level(field: Tensor, vertical: Tensor) -> Tensor:
    return field - (field * vertical).sum(-1, keepdim=True) * vertical


def evenly(count: int) -> Tensor:
    """Numbers of some of so many rows."""
    return torch.arange(0, count, max(1, count // _ROWS))
