"""A parameter of the simulation that depends on a recorded column, linearly."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.base import GainEffect
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.waveforms import per

if TYPE_CHECKING:
    from jaxtyping import Float

ROLES = ("any", "temperature", "current")
"""Roles of the columns that a parameter can depend on."""

ADVICE = "Let the parameter depend on the column, and fit it again."


class DriverParameter(GainEffect):
    """A parameter depends on a recorded column: a resistance on temperature, a drag on density, a rate on the flow.

    Simulation: replaces a parameter p of differential equations by ``p (1 + γ (d − d̄))``; d̄ is the column's mean.
    Drivers: any column.
    Units: γ per unit of the column.
    Plausible: any size, either sign.
    Source: temperature coefficients, such as that of resistance in IEC 60751; linear in the cause.
    """

    id = "driver_parameter"
    display_name = "parameter that depends on a column"
    port = "parameter"
    follows_signal = True
    needs: tuple[str, ...] = ("own",)
    roles: tuple[str, ...] = ROLES
    gain = "per_unit"
    equation = "δp = γ (d − d̄) p"
    explanation = "The parameter depends on this column."
    advice = ADVICE
    source = "temperature coefficients, such as that of resistance in IEC 60751; linear in the cause"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity(self.gain, 1, per_unit(context)),)

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        return context.drivers[:, 0] * context.part("own")

    def explained(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        return f"{slope_in_words(gamma[0], context)}."

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        return (f"{gamma[0]!r} * {names['driver']} * {names['own']}",)


def per_unit(context: Context) -> str:
    """The unit of a share per unit of the driver; empty if the driver has none."""
    return per("1", context.units[0]) if context.units[0] else ""


def slope_in_words(slope: float, context: Context) -> str:
    """By how many per cent of itself a parameter changes per unit of the driver, as a clause."""
    unit = context.units[0]
    column = f"`{context.columns[0]}`" if context.columns else "this column"
    return f"`{context.channels[0]}` changes by {100.0 * slope:.3g} % per {unit or 'unit'} with {column}"
