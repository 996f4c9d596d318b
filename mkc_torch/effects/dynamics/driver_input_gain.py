"""Dependence of an actuator's gain on a column."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.base import GainEffect
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.waveforms import per

if TYPE_CHECKING:
    from jaxtyping import Float


class DriverInputGain(GainEffect):
    """An actuator's gain depends on a recorded column: thrust on the battery's voltage, a pump's flow on viscosity.

    Simulation: adds ``γ (d − d̄) u`` to an input u of differential equations that is not the surroundings of a state;
        d̄ is the column's mean. For other simulations see :class:`mkc_torch.effects.paired.driver_gain.DriverGain`.
    Drivers: any column.
    Units: γ per unit of the column.
    Plausible: any size, either sign.
    Source: temperature and supply coefficients of gain; Doebelin, "Measurement Systems" (2003), 3.2.
    """

    id = "driver_input_gain"
    display_name = "actuator's gain that depends on a column"
    port = "input"
    follows_signal = True
    needs: tuple[str, ...] = ("own", "actuator")
    roles: tuple[str, ...] = ("any", "temperature", "current")
    gain = "gain_per_unit"
    equation = "δu = γ (d − d̄) u"
    explanation = "The input acts more or less strongly, by a factor that depends on this column."
    advice = "Multiply the input by this factor; find out how the column changes the actuator, such as by its supply."
    source = "Doebelin, Measurement Systems (2003), 3.2"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity(self.gain, 1, per("1", context.units[0]) if context.units[0] else ""),)

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        return context.drivers[:, 0] * context.part("own")

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        return (f"{gamma[0]!r} * {names['driver']} * {names['own']}",)
