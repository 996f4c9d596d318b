"""A spring that hardens or softens."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.dynamics.rate import RateEffect

if TYPE_CHECKING:
    from jaxtyping import Float


class CubicStiffness(RateEffect):
    """A nonlinear spring: harder or softer at large deflections.

    Simulation: adds ``−γ x³`` to the rate of the speed whose position is x.
    Drivers: the position only.
    Units: γ in the speed's unit per s and cube of the position's unit.
    Plausible: either sign; negative for a softening spring.
    Source: Duffing, "Erzwungene Schwingungen bei veränderlicher Eigenfrequenz" (1918).
    """

    id = "cubic_stiffness"
    needs = ("position", "deflection")
    lower = -math.inf
    gain = "stiffness"
    power = 3.0
    plot_axis = "position"
    equation = "δv̇ = −γ x³"
    explanation = "The restoring force is not linear: the spring is harder, or softer, at large deflections."
    advice = "Add a cubic spring with this coefficient."
    source = "Duffing's oscillator"

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        return -context.part("position").pow(3)

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        return (f"-({gamma[0]!r}) * {names['position']} ** 3",)
