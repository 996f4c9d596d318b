"""Linear dependence of an output on a column."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.unit_text import quotient
from mkc_torch.effects.base import GainEffect
from mkc_torch.effects.context import Context, Quantity, Shape

if TYPE_CHECKING:
    from jaxtyping import Float


class DriverLinear(GainEffect):
    """The measured output depends linearly on a column that the simulation does not use, or uses otherwise.

    Simulation: adds ``b + k (x − x̄)`` to an output; without b where a parameter of the simulation shifts the output.
    Drivers: any column, inputs of the simulation too, such as the position of a spring.
    Units: k in the output's unit per unit of the column, b in the output's unit.
    Plausible: any size.
    Source: the linear response to any small disturbance.

    Attributes:
        degree: degree of the polynomial in x.
    """

    id = "driver_linear"
    display_name = "linear dependence"
    port = "output"
    needs = ("own", "compared")
    is_generalisation = True  # with b, a plain offset is a special case
    roles: tuple[str, ...] = ("any", "temperature", "current", "input")
    equation = "δy = b + k (x − x̄)"
    explanation = "The measured output depends linearly on this column."
    advice = "Find out how the column acts on the sensor or the system; correct with the fitted gain until then."
    source = "linear response, first order in the driver"
    degree = 1

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        slopes = (
            Quantity("per_unit", 1, self.unit(context)),
            Quantity("per_square", 1, quotient(context.signal_unit, context.units[0], 2)),
        )
        zero = (Quantity("at_mean", 1, context.signal_unit),) if "fixed zero" in context.parts else ()
        return slopes[: self.degree] + zero

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N 1"]:
        x = context.drivers[:, 0]
        columns = [x.pow(k) for k in range(1, self.degree + 1)]
        if "fixed zero" in context.parts:
            columns.append(torch.ones_like(x))
        return (torch.stack(columns, -1) @ gamma).unsqueeze(-1)
