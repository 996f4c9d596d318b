"""An actuator that follows its command with a lag."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.share import ShareEffect
from mkc_torch.effects.waveforms import lagged

if TYPE_CHECKING:
    from jaxtyping import Float

SHARES = (0.001, 0.003, 0.01, 0.03, 0.1)
"""Time constants to search, as shares of the longest run."""


class InputLag(ShareEffect):
    """The actuator follows its command through a first-order lag: motor drivers, valves, radiators, propellers.

    A delay shifts the command in time and keeps its shape; a lag smooths it. At the first sample of a run the actuator
    is at its command.

    Simulation: adds ``γ (u_τ − u)`` to an input u, where u_τ is the input behind a first-order lag,
        ``τ u̇_τ = u − u_τ``; γ = 1 is a pure lag.
    Drivers: the input only, with its history since the start of the run.
    Units: γ is a share; the time constant ``lag`` in s.
    Plausible: γ from 0 to 1.
    Source: actuator dynamics; Ogata, "Modern Control Engineering" (2010), 5.2.
    """

    id = "input_lag"
    remembers = True
    continuous: Mapping[str, tuple[float, float]] = {"lag": (0.0005, 0.3)}
    fitted_shape: Mapping[str, tuple[float, float]] = {"lag": (0.0005, 0.3)}
    equation = "δu = γ (u_τ − u),  τ u̇_τ = u − u_τ"
    explanation = "The actuator follows its command through a first-order lag."
    advice = "Put a first-order lag of this time constant behind the input."
    recurrence = "a lag makes fast changes of its input smaller"
    source = "actuator dynamics; Ogata, Modern Control Engineering (2010), 5.2"

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:
        length = float(time.max() - time.min())
        return tuple({"lag": share * length} for share in SHARES)

    def within_a_sample(self, shape: Shape, step: float) -> bool:
        return shape["lag"] <= step

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        own = context.part("own")
        return lagged(own, context.time, shape["lag"], context.runs) - own

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        own = names["own"]
        return (f"{gamma[0]!r} * (lagged({own}, time, {shape['lag']!r}, run) - {own})",)
