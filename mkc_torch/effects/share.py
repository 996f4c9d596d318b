"""Effects whose amplitude is a share: absent at γ = 0, complete at γ = 1."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.base import GainEffect
from mkc_torch.effects.context import Context, Quantity, Shape

if TYPE_CHECKING:
    from jaxtyping import Float

CORNER = 0.1
"""Softness of a corner in the grid search; see :func:`soft_clip`."""

SOFTNESS = 0.02, 2.0
"""Range of the softness of a corner in a fit."""


class ShareEffect(GainEffect):
    """An effect on an input or an output whose amplitude is a share between 0 and 1. Implement ``waveform``."""

    port = "input"
    follows_signal = True
    natural_ends: Mapping[str, tuple[str, ...]] = {"softness": ("least", "greatest")}
    lower = 0.0
    upper = 1.0
    needs: tuple[str, ...] = ("own",)
    plausible = 1.5
    gain = "share"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity(self.gain, len(context.channels), ""),)


class Saturation(ShareEffect):
    """A signal limited on both sides. Set the ``limits`` to search, as shares of the largest value."""

    relative: Mapping[str, tuple[str, str]] = {"limit": ("own", "largest")}
    fitted_shape: Mapping[str, tuple[float, float]] = {"limit": (0.2, 0.99)}
    plot_axis = "own"
    limits: tuple[float, ...]
    source = "Khalil, Nonlinear Systems (2002), 1.2.7"

    def shapes(self, time: object) -> Sequence[Shape]:
        return tuple({"limit": limit} for limit in self.limits)

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        own, limit = context.part("own"), shape["limit"]
        return own.clamp(-limit, limit) - own

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        own, limit = names["own"], shape["limit"]
        return (f"{gamma[0]!r} * ({own}.clamp({-limit!r}, {limit!r}) - {own})",)


def soft_clip(values: Float[Tensor, " N"], limit: float | Tensor, softness: float | Tensor) -> Float[Tensor, " N"]:
    """Values limited on both sides, with rounded corners.

    ``s c ln(cosh((u + b) / w) / cosh((u − b) / w))`` with the corner at ``b = c tanh(1 / (2 s))`` and ``w = 2 s b``:
    its slope at 0 is 1 and its limit is c for any softness s. A small softness is a hard clip, a large softness
    ``c tanh(u / c)``.

    Args:
        values: u.
        limit: c, in the values' unit; positive.
        softness: s, the width of the corner as a share of its position; positive.

    Example:
        >>> [round(float(u), 2) for u in soft_clip(torch.tensor([0.5, 1.0, 4.0]), 1.0, 0.02)]
        [0.5, 0.99, 1.0]
        >>> [round(float(u), 2) for u in soft_clip(torch.tensor([0.5, 1.0, 4.0]), 1.0, 3.0)]
        [0.46, 0.76, 1.0]
    """
    softness = torch.as_tensor(softness, dtype=values.dtype, device=values.device)
    corner = limit * torch.tanh(0.5 / softness)
    width = 2.0 * softness * corner
    return softness * limit * (_log_cosh((values + corner) / width) - _log_cosh((values - corner) / width))


def _log_cosh(values: Tensor) -> Tensor:
    """log cosh plus log 2."""
    return values.abs() + torch.nn.functional.softplus(-2.0 * values.abs())
