"""Points of a curve, closer together where it bends."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

FINE_POINTS = 800
"""Number of evenly spaced points at which a curve is computed."""

_POINTS = 80
"""Number of points of a curve that are closer at bends."""

_EVEN_POINTS = 160
"""Number of evenly spaced points: of a free curve, and over time."""

_FOR_BENDS = 0.8
"""Share of the points that goes to bends; the others are evenly spaced."""

_STRAIGHT = 1e-9
"""Second difference, over the range of the curve, below which the curve is straight up to rounding."""


def drawn_points(value: Float[Tensor, "N n"], *, evenly: bool) -> Tensor:
    """Return indices of the points that are kept of a finely sampled curve: evenly spaced, or closer at bends."""
    if evenly:
        return torch.linspace(0, len(value) - 1, min(_EVEN_POINTS, len(value))).long()
    return bending_points(value, _POINTS)


def bending_points(value: Float[Tensor, "N n"], count: int) -> Tensor:
    """Return indices of at most ``count`` rows of a finely sampled curve, closer together where it bends.

    The density of points follows the square root of the second difference, which makes the error of straight lines
    between them equal everywhere. The first and the last row are included.

    Args:
        value: the curve's values at evenly spaced places, in any unit; channels count alike.
        count: number of points.

    Example:
        >>> step = torch.linspace(-1.0, 1.0, 801).mul(50.0).tanh().unsqueeze(-1)
        >>> chosen = bending_points(step, 80)
        >>> int(((chosen > 350) & (chosen < 450)).sum()) > 40  # 10 if evenly spaced
        True
    """
    N = len(value)
    if count >= N:
        return torch.arange(N)
    bend = value.diff(n=2, dim=0).abs() / (value.amax(0) - value.amin(0)).clamp(min=torch.finfo(value.dtype).tiny)
    bend = bend.amax(-1).nan_to_num(0.0, 0.0, 0.0)
    density = torch.nn.functional.pad(torch.where(bend > _STRAIGHT, bend, 0.0).sqrt(), (1, 1))
    total = density.sum()
    share = density / total if float(total) > 0.0 else torch.zeros_like(density)
    mixed = _FOR_BENDS * share + (1.0 - _FOR_BENDS * float(share.sum() > 0)) / N
    at = torch.linspace(0.0, float(mixed.sum()), count, dtype=value.dtype)
    chosen = torch.searchsorted(mixed.cumsum(0), at).clamp(max=N - 1)
    return torch.cat([chosen, torch.tensor([0, N - 1])]).unique()
