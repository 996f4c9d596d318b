"""Dry friction at an output, as a function of a column."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.base import GainEffect
from mkc_torch.effects.context import Context, Shape

if TYPE_CHECKING:
    from jaxtyping import Float

WIDTHS = (0.05, 0.15, 0.4)
"""Widths of the transition to search, as shares of the largest value of the column."""


class DriverFriction(GainEffect):
    """The output has a part that only follows the sign of a column, smoothed near 0: dry friction of a speed.

    The width of the transition is that of presliding, or of lubrication. A column of one sign has no reversal, so its
    friction is a constant.

    Simulation: adds ``γ tanh(x / s)`` to an output.
    Drivers: any column with its zero, inputs of the simulation too.
    Units: γ in the output's unit; s, the width of the transition, in that of the column.
    Plausible: either sign: that of a force depends on how it is counted.
    Source: the Coulomb model, smoothed; Andersson, Söderberg & Björklund, "Friction models for sliding dry, boundary
        and mixed lubricated contacts", Tribology International 40 (2007), 580, eq. 4.

    Example:
        >>> import torch
        >>> speed = torch.tensor([[-2.0], [0.0], [2.0]])
        >>> context = Context(torch.arange(3.0), speed, ("m/s",), torch.zeros(3, 1), "N", ("force",))
        >>> DriverFriction().change(torch.tensor([60.0]), {"width": 2.0}, context).squeeze(-1)
        tensor([-45.6957,   0.0000,  45.6957])
    """

    id = "driver_friction"
    display_name = "dry friction of a column"
    port = "output"
    needs = ("own", "compared")
    roles: tuple[str, ...] = ("any", "current", "input")
    relative: Mapping[str, tuple[str, str]] = {"width": ("driver", "largest")}
    fitted_shape: Mapping[str, tuple[float, float]] = {"width": (0.01, 0.5)}
    natural_ends: Mapping[str, tuple[str, ...]] = {"width": ("least",)}
    gain = "level"
    equation = "δy = γ tanh(x / s),  s the width"
    explanation = "The output has a part that follows the sign of this column and not its size, as dry friction does."
    advice = "Add dry friction of this level and this width of its transition."
    source = "Andersson, Söderberg & Björklund, Tribology International 40 (2007), 580, eq. 4"

    def shapes(self, time: object) -> Sequence[Shape]:
        return tuple({"width": share} for share in WIDTHS)

    def unit(self, context: Context) -> str:
        return context.signal_unit

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        return torch.tanh(context.recorded / shape["width"])
