"""Linear dependence of an output on two columns together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.base import GainEffect
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.waveforms import per

if TYPE_CHECKING:
    from jaxtyping import Float


class DriverPair(GainEffect):
    """The measured output depends linearly on two columns, each of which alone explains little.

    Columns that were varied together, such as a load and a temperature that rises with it, hide each other: one column
    alone takes the wrong sign or half of its size.

    Simulation: adds ``b + k₁ (x₁ − x̄₁) + k₂ (x₂ − x̄₂)`` to an output; without b where a parameter of the simulation
        shifts the output.
    Drivers: any two columns that the simulation does not use.
    Units: k in the output's unit per unit of each column, b in the output's unit.
    Plausible: any size.
    Source: the linear response to small disturbances; on columns that hide each other, Hamilton, "Sometimes
        R² > r²(y, x₁) + r²(y, x₂)", The American Statistician 41 (1987), 129.
    """

    id = "driver_pair"
    display_name = "linear dependence on two columns"
    port = "output"
    needs = ("own", "compared")
    is_generalisation = True  # one of the columns alone is a special case
    roles: tuple[str, ...] = ("pair",)
    equation = "δy = b + k₁ (x₁ − x̄₁) + k₂ (x₂ − x̄₂)"
    explanation = "The measured output depends linearly on both columns."
    advice = "Find out how both columns act on the sensor or the system; correct with the fitted gains until then."
    source = "Hamilton, The American Statistician 41 (1987), 129"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        slopes = tuple(
            Quantity(f"per_unit_{k}", 1, per(context.signal_unit, unit))
            for k, unit in enumerate(context.units, start=1)
        )
        return (*slopes, *([Quantity("at_mean", 1, context.signal_unit)] if "fixed zero" in context.parts else []))

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N 1"]:
        columns = [context.drivers]
        if "fixed zero" in context.parts:
            columns.append(torch.ones_like(context.drivers[:, :1]))
        return (torch.cat(columns, -1) @ gamma).unsqueeze(-1)
