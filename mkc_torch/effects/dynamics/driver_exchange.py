"""Exchange of heat with a recorded temperature."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.dynamics.rate import RateEffect
from mkc_torch.effects.kinds import zero_of

if TYPE_CHECKING:
    from jaxtyping import Float


class DriverExchange(RateEffect):
    """A body exchanges heat with a neighbour whose temperature is recorded: another room, the ground, a coolant.

    Simulation: adds ``γ (T_d − T)`` to the rate of a temperature T, where T_d is a recorded temperature that the
        simulation does not use.
    Drivers: a temperature.
    Units: γ in 1/s.
    Plausible: γ ≥ 0.
    Source: Newton's law of cooling.
    """

    id = "driver_exchange"
    display_name = "heat exchange with a recorded temperature"
    needs = ("own", "temperature")
    roles: tuple[str, ...] = ("temperature",)
    gain = "exchange"
    equation = "δṪ = γ (T_d − T)"
    explanation = "The body exchanges heat with something that has this temperature."
    advice = "Make the column an input of the simulation, with an exchange of heat in proportion to the difference."
    source = "Newton's law of cooling"

    def unit(self, context: Context) -> str:
        return "1/s"

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        own = context.unit_of("own")
        # a column without a unit is in that of the state
        zeros = zero_of(context.units[0] or own) - zero_of(own)
        return context.recorded + zeros - context.part("own")

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        other, own = names["recorded"], names["own"]
        if names["zero_of_driver"] != names["zero"]:
            other, own = f"{other} + {names['zero_of_driver']}", f"{own} - {names['zero']}"
        return (f"{gamma[0]!r} * ({other} - {own})",)
