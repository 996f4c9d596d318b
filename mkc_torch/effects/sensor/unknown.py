"""An unnamed smooth response to a recorded column."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.unit_text import sized
from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import Context, Quantity, Shape

if TYPE_CHECKING:
    from jaxtyping import Float

DEGREE = 3
"""Degree of the polynomial."""


class Unknown(Effect):
    """The offset depends on a column by a smooth curve: physics outside the catalogue.

    Simulation: adds ``Σ γ_j P_j(x)`` to the sensor's axes, with Legendre polynomials P_1 to P_3 and the column's range
    in the recording mapped to [-1, 1]; outside of it the curve is constant.
    Drivers: one column of any role.
    Units: γ in µT.
    Plausible: any size.
    Source: none; it is a curve, not physics.

    Example:
        >>> from mkc_torch.effects import Context
        >>> column = torch.tensor([[-3.0], [0.0], [3.0]])
        >>> context = Context(torch.arange(3.0), column, ("V",), torch.zeros(3, 1), "µT", ("x",))
        >>> Unknown().change(torch.tensor([2.0, 1.0, 0.0]), {}, context).squeeze(-1)  # a line and a parabola
        tensor([-1.0000, -0.5000,  3.0000])
    """

    id = "unknown"
    display_name = "an effect outside the catalogue"
    is_curve = True
    roles = ("temperature", "current", "any")
    equation = "δB = f(x), a smooth curve"
    explanation = "The offset depends on this column by a curve that no effect of the catalogue describes."
    advice = "Look at the curve; find out what the column does to the sensor."
    source = "none: a curve, not physics"

    def equation_of(self, shape: Shape, context: Context) -> str:
        x, unit = context.drivers[:, 0], context.units[0]
        low, high = sized(float(x.min()), unit), sized(float(x.max()), unit)
        return (
            f"{self.equation},  f(x) = Σ γ_j P_j(u),  P_j Legendre's polynomials,  u from −1 to 1 where x − x̄ goes "
            f"from {low} to {high}, constant beyond"
        )

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return tuple(
            Quantity(f"legendre_{j}", len(context.channels), context.signal_unit) for j in range(1, DEGREE + 1)
        )

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        x = context.drivers[:, 0]
        low, high = shape.get("low", x.min()), shape.get("high", x.max())
        t = ((2.0 * x - low - high) / (high - low)).clamp(-1.0, 1.0)
        polynomials = torch.stack([t, 1.5 * t**2 - 0.5, 2.5 * t**3 - 1.5 * t], -1)
        return polynomials @ gamma.reshape(DEGREE, -1)

    def bind(self, shape: Shape, context: Context) -> Shape:
        """The shape with the column's range in this recording, for use on another recording."""
        x = context.drivers[:, 0]
        return {**shape, "low": float(x.min()), "high": float(x.max())}
