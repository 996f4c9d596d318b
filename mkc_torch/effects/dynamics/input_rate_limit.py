"""An actuator that moves no faster than a limit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.share import ShareEffect
from mkc_torch.effects.waveforms import rate_limited

if TYPE_CHECKING:
    from jaxtyping import Float

RATES = (0.003, 0.01, 0.03, 0.1, 0.2, 0.3, 0.5, 0.7, 0.85)
"""Fastest change of the actuator, as shares of the fastest change of its input; small ones for inputs with steps."""


class InputRateLimit(ShareEffect):
    """The actuator has a largest speed: servos, valves, control surfaces, ramps of a drive.

    Slow commands are followed exactly; a fast one is a ramp, whatever its size. A lag is late in any command. At the
    first sample of a run the actuator is at its command.

    Simulation: adds ``γ (y − u)`` to an input u, where y follows u with ``|ẏ| ≤ r``; γ = 1 is a pure limit.
    Drivers: the input only, with its history since the start of the run.
    Units: γ is a share; the shape ``rate`` in the unit of the input per s.
    Plausible: γ from 0 to 1.
    Source: the rate limiter of servos; Stein, "Respect the Unstable", IEEE Control Systems Magazine 23 (2003); Duda,
        "Prediction of Pilot-in-the-Loop Oscillations due to Rate Saturation", JGCD 20 (1997).
    """

    id = "input_rate_limit"
    remembers = True
    needs = ("own", "pace")
    relative: Mapping[str, tuple[str, str]] = {"rate": ("pace", "largest")}
    fitted_shape: Mapping[str, tuple[float, float]] = {"rate": (0.001, 0.99)}
    equation = "δu = γ (y − u),  ẏ towards u with |ẏ| ≤ r"
    explanation = "The actuator has a largest speed: it follows a fast command as a ramp."
    advice = "Limit the rate of the input to this value."
    source = "Stein, Respect the Unstable (2003); Duda, JGCD 20 (1997)"

    def shapes(self, time: object) -> Sequence[Shape]:
        return tuple({"rate": rate} for rate in RATES)

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        own = context.part("own")
        return rate_limited(own, context.time, shape["rate"], context.runs) - own

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        own = names["own"]
        return (f"{gamma[0]!r} * (rate_limited({own}, time, {shape['rate']!r}, run) - {own})",)
