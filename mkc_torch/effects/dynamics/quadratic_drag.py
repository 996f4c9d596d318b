"""Drag in proportion to the square of the speed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.dynamics.rate import RateEffect

if TYPE_CHECKING:
    from jaxtyping import Float


class QuadraticDrag(RateEffect):
    """Drag of a blunt body in air or water: against the speed, in proportion to its square.

    Simulation: adds ``−γ v |v|`` to the rate of a speed v.
    Drivers: the state only.
    Units: γ in 1/m for a speed in m/s: ½ ρ c_d A / m.
    Plausible: γ ≥ 0.
    Source: Rayleigh's drag equation, Reynolds numbers from 10³ on.
    """

    id = "quadratic_drag"
    needs = ("own", "flowing")  # it has no physical meaning for a temperature
    gain = "drag"
    power = 2.0
    equation = "δv̇ = −γ v |v|"
    explanation = "The motion is slowed by the square of its speed, as by air."
    advice = "Add air drag with this coefficient, ½ ρ c_d A / m."
    by_kind: Mapping[str, tuple[str, str]] = {
        "level": (
            "The level falls in proportion to its square.",
            "Add an outflow that grows with the square of the level, as over a weir or where a vessel narrows.",
        ),
        "voltage": (
            "The charge leaks in proportion to the square of the voltage.",
            "Look for a transistor or a diode in parallel.",
        ),
        "current": (
            "The current is braked by its square.",
            "Look for a resistance that grows with the current, as of a filament, or for a core that saturates.",
        ),
        "pressure": (
            "The pressure falls in proportion to its square.",
            "Add an outflow that grows with the square of the pressure.",
        ),
    }
    source = "Rayleigh's drag equation"

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        own = context.part("own")
        return -own * own.abs()

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        return (f"-{gamma[0]!r} * {names['own']} * {names['own']}.abs()",)
