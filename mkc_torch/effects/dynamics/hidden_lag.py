"""A storage that is missing in the equations and follows a state with a lag."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.unit_text import duration
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.dynamics.rate import RateEffect, second_mass, size_of_second
from mkc_torch.effects.kinds import MOTION, kind_at
from mkc_torch.effects.waveforms import lagged

if TYPE_CHECKING:
    from jaxtyping import Float

SHARES = (0.005, 0.015, 0.05, 0.15)
"""Time constants to search, as shares of the longest run."""


_EXAMPLES = {
    "temperature": ": a wall, furniture, a housing, the vessel itself",
    "speed": ": a load on a slipping coupling, a liquid carried along",
    "rotation": ": a load on a slipping coupling, a liquid carried along",
}
"""Examples of the second store, by the kind of quantity."""


class HiddenLag(RateEffect):
    """A second store behind a resistance: heat in a wall, water in a side tank, a mass that a damper drags along.

    Simulation: adds ``γ (z − x) / τ`` to the rate of a state x, with an internal state z that starts at x:
        ``τ ż = x − z``. What the state loses, the store gains.
    Drivers: the state only, with its history since the start of the run.
    Units: γ, the store's capacity as a share of the state's, is a number, or at the force on a joint an inertia in
        kg m² or kg; the time constant τ in s.
    Plausible: γ from 0 to 100: the structure of a house holds up to some 50 times the heat of its air. A store with a
        very short lag only adds to the capacity; where that is a parameter of the simulation, γ is not identifiable
        without this bound.
    Source: two-node thermal networks; Bacher & Madsen, Energy and Buildings 43 (2011); Maxwell's model of a damper.
    """

    id = "hidden_lag"
    port = "lagged rate"
    is_generalisation = True
    continuous: Mapping[str, tuple[float, float]] = {"time_constant": (0.001, 0.4)}
    fitted_shape: Mapping[str, tuple[float, float]] = {"time_constant": (0.001, 0.4)}
    upper = 100.0
    gain = "share"
    plot_axis = ""
    equation = "δẋ = γ (z − x) / τ,  τ ż = x − z"
    explanation = "The state exchanges with a store that is not in the equations and follows it with a lag."
    advice = "Add a second store with this time constant, such as a wall behind a resistance."
    display_name_by_kind: Mapping[str, str] = {
        "temperature": "second store of heat",
        "level": "side tank",
        "pressure": "second volume",
        "voltage": "second capacitor",
        "current": "second coil",
    }
    stores: Mapping[str, str] = {
        "temperature": "a second store of heat",
        "level": "a side tank",
        "pressure": "a second volume behind a throttle",
        "voltage": "a second capacitor behind a resistor",
        "current": "a second coil parallel to a resistor",
        "speed": "a mass dragged along by a damper",
        "rotation": "a flywheel dragged along by a damper",
    }
    source = "two-node thermal networks; Bacher & Madsen, Energy and Buildings 43 (2011)"

    def store(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        """A phrase with the store, its size and its time constant."""
        known = self.stores.get(kind_at(context), "a second store")
        evens_out = "catching up" if kind_at(context) in MOTION else "exchanging"
        time = duration(float(shape["time_constant"]))
        return f"{known}, {size_of_second(float(gamma[0]), context, 'of the first')}, {evens_out} in {time}"

    def explained(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        return (
            f"There is {self.store(gamma, shape, context)}, that is not in the equations. Its size holds if it was in "
            "balance with the state at the start of each run; otherwise it has another size."
        )

    def advised(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        return (
            f"Add {self.store(gamma, shape, context)}{_EXAMPLES.get(kind_at(context), '')}. If it did not start in "
            "balance with the first, refit its start and its size."
        )

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:
        length = float(time.max() - time.min())
        return tuple({"time_constant": share * length} for share in SHARES)

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (second_mass(context),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        """The exchange and, while a trajectory is solved, the rate of z, (N, 2); else along the known path, (N, 1)."""
        x, z, lag = context.part("own"), context.memory, shape["time_constant"]
        if z is None:
            return (gamma[0] * (lagged(x, context.time, lag, context.runs) - x) / lag).unsqueeze(-1)
        flow = (x - z) / lag
        return torch.stack([-gamma[0] * flow, flow], -1)

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        flow = f"({names['own']} - {names['memory']}) / {shape['time_constant']!r}"
        return f"-{gamma[0]!r} * {flow}", flow
