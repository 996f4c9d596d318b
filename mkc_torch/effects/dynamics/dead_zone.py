"""An actuator that does not respond to small commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.share import CORNER, SOFTNESS, ShareEffect, soft_clip

if TYPE_CHECKING:
    from jaxtyping import Float

WIDTHS = (0.03, 0.06, 0.1, 0.2, 0.3)
"""Widths to search, as shares of the largest input."""


class DeadZone(ShareEffect):
    """Small commands have no effect, and large commands lose the same amount: valves with overlap, sticking amplifiers.

    It has no memory: the response is the same in both directions. With memory it is
    :class:`mkc_torch.effects.dynamics.backlash.Backlash`.

    Simulation: adds ``−γ clip(u, ±c)`` to an input u, by :func:`mkc_torch.effects.share.soft_clip`; γ = 1 without
        softness is a full dead zone.
    Drivers: the input only.
    Units: γ is a share; the shape ``width`` in the unit of the input, ``softness`` a share of the width.
    Plausible: γ from 0 to 1.
    Source: Khalil, "Nonlinear Systems" (2002), 1.2.7.
    """

    id = "dead_zone"
    relative: Mapping[str, tuple[str, str]] = {"width": ("own", "largest")}
    fitted_shape: Mapping[str, tuple[float, float]] = {"width": (0.01, 0.7), "softness": SOFTNESS}
    plot_axis = "own"
    equation = "δu = −γ clip(u, ±c)"
    explanation = "Small commands have no effect: the actuator has a dead zone."
    advice = "Subtract this amount from the size of every command."
    source = "Khalil, Nonlinear Systems (2002), 1.2.7"

    def shapes(self, time: object) -> Sequence[Shape]:
        return tuple({"width": width, "softness": CORNER} for width in WIDTHS)

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        return -soft_clip(context.part("own"), shape["width"], shape["softness"])

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        return (f"-{gamma[0]!r} * soft_clip({names['own']}, {shape['width']!r}, {shape['softness']!r})",)
