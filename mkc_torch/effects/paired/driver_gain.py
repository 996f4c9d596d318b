"""Dependence of an output's scale on a column."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.base import GainEffect
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.waveforms import per

if TYPE_CHECKING:
    from jaxtyping import Float


class DriverGain(GainEffect):
    """The output's scale depends linearly on a recorded column: a temperature coefficient, slip under acceleration.

    Simulation: adds ``(b + k (x − x̄)) y`` to an output y; without b where a parameter of the simulation scales it.
    Drivers: any column.
    Units: k per unit of the column, b is a share.
    Plausible: any size.
    Source: temperature coefficients of sensitivity; Doebelin, "Measurement Systems" (2003), 3.2.
    """

    id = "driver_gain"
    display_name = "dependence of the gain"
    port = "output"
    needs = ("own", "compared")
    follows_signal = True
    is_generalisation = True  # with b, a plain gain is a special case
    roles: tuple[str, ...] = ("any", "temperature", "current")
    equation = "δy = (b + k (x − x̄)) y"
    explanation = "The output's scale depends linearly on this column."
    advice = (
        "Multiply the simulated output by this factor, as for a temperature coefficient; find out how the column "
        "changes the sensor's or the system's gain."
    )
    source = "Doebelin, Measurement Systems (2003), 3.2"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        scale = (Quantity("gain_at_mean", 1, ""),) if "fixed scale" in context.parts else ()
        return (Quantity("gain_per_unit", 1, per("1", context.units[0]) if context.units[0] else ""), *scale)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N 1"]:
        share = gamma[0] * context.drivers[:, 0]
        if "fixed scale" in context.parts:
            share = share + gamma[1]
        return (share * context.part("own")).unsqueeze(-1)
