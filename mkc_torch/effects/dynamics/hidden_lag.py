"""A part that follows a state late, and that the equations do not have."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.unit_text import duration, share_of
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.courses import lagged
from mkc_torch.effects.dynamics.rate import RateEffect
from mkc_torch.effects.kinds import MOTION, kind_at

if TYPE_CHECKING:
    from jaxtyping import Float

SHARES = (0.005, 0.015, 0.05, 0.15)
"""Time constants that are searched, as shares of the longest run."""


_EXAMPLES = {
    "temperature": ": a wall, furniture, a housing, the vessel itself",
    "speed": ": a load on a slipping coupling, a liquid carried along",
    "rotation": ": a load on a slipping coupling, a liquid carried along",
}
"""What the second store may be."""


class HiddenLag(RateEffect):
    """A second store behind a resistance: heat in a wall, water in a side tank, a mass that a damper drags along.

    Simulation: adds ``γ (z − x) / τ`` to the rate of a state x, with an internal state z of its own that begins like x:
        ``τ ż = x − z``. What the state gives off, the store takes up.
    Drivers: none but the state, all of its course since the run's beginning.
    Units: γ, the store's capacity as a share of the state's own, is a number; the time constant τ in s.
    Plausible: γ from 0 to thirty, for exchange evens out; a store that follows at once only adds to the capacity, which
        is often a parameter of the simulation, and then nothing would hold γ.
    Source: two-node thermal networks; Bacher & Madsen, Energy and Buildings 43 (2011); Maxwell's model of a damper.
    """

    id = "hidden_lag"
    port = "lagged rate"
    is_generalisation = True
    continuous: Mapping[str, tuple[float, float]] = {"time_constant": (0.001, 0.4)}
    fitted_shape: Mapping[str, tuple[float, float]] = {"time_constant": (0.001, 0.4)}
    upper = 30.0
    gain = "share"
    plot_axis = ""
    equation = "δẋ = γ (z − x) / τ,  τ ż = x − z"
    explanation = "The state exchanges with something that is not in the equations and follows it late."
    advice = "Add a second store with this time constant, such as a wall behind a resistance."
    words_by_kind: Mapping[str, str] = {
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
        "current": "a second coil beside a resistor",
        "speed": "a mass dragged along by a damper",
        "rotation": "a flywheel dragged along by a damper",
    }
    source = "two-node thermal networks; Bacher & Madsen, Energy and Buildings 43 (2011)"

    def store(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        """The store with its size and its time, as a person says them."""
        known = self.stores.get(kind_at(context), "a second store")
        evens_out = "catching up" if kind_at(context) in MOTION else "exchanging"
        time = duration(float(shape["time_constant"]))
        return f"{known}, {share_of(float(gamma[0]))} of the first, {evens_out} in {time}"

    def explained(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        return f"There is {self.store(gamma, shape, context)}, that is not in the equations."

    def advised(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        return f"Add {self.store(gamma, shape, context)}{_EXAMPLES.get(kind_at(context), '')}."

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:
        length = float(time.max() - time.min())
        return tuple({"time_constant": share * length} for share in SHARES)

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:  # noqa: ARG002
        return (Quantity(self.gain, 1, ""),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        """The exchange, and beside it the rate of z, where z is solved for; along the known path, where it is not."""
        x, z, lag = context.part("own"), context.memory, shape["time_constant"]
        if z is None:
            return (gamma[0] * (lagged(x, context.time, lag, context.runs) - x) / lag).unsqueeze(-1)
        gone = (x - z) / lag
        return torch.stack([-gamma[0] * gone, gone], -1)

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        gone = f"({names['own']} - {names['memory']}) / {shape['time_constant']!r}"
        return f"-{gamma[0]!r} * {gone}", gone
