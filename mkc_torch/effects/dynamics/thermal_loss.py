"""Loss of heat by radiation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.dynamics.rate import SURROUNDINGS, RateEffect
from mkc_torch.effects.kinds import zero_of

if TYPE_CHECKING:
    from jaxtyping import Float


ROOM = 293.15
"""Room temperature in K."""


class ThermalLoss(RateEffect):
    """A body loses heat by radiation, with the fourth power of its temperature.

    Simulation: adds ``−γ (T⁴ − T₀⁴) / (4 T₀³)`` to the rate of a temperature, T absolute and T₀ 293 K; where an input
        u is the temperature of the surroundings, ``−γ (T⁴ − u⁴) / (4 T₀³)``.
    Drivers: the state only.
    Units: γ in 1/s, the coefficient of a linear loss near T₀.
    Plausible: γ ≥ 0.
    Source: Stefan and Boltzmann's law.

    Args:
        to_surroundings: whether it radiates to surroundings whose temperature is an input.
    """

    id = "thermal_loss"
    needs: tuple[str, ...] = ("own", "temperature")
    excludes: tuple[str, ...] = (SURROUNDINGS,)  # a body radiates to its surroundings where they are known
    gain = "loss"
    equation = "δṪ = −γ (T⁴ − T₀⁴) / (4 T₀³)"
    explanation = "The body loses heat with the fourth power of its absolute temperature: it radiates."
    advice = "Add radiation with this coefficient."
    source = "Stefan and Boltzmann's law"

    def __init__(self, *, to_surroundings: bool = False) -> None:
        if to_surroundings:
            self.needs, self.form_parameters = ("own", "temperature", SURROUNDINGS), (SURROUNDINGS,)
            self.excludes = ()
            self.equation = "δṪ = −γ (T⁴ − u⁴) / (4 T₀³)"

    def shapes(self, time: object) -> Sequence[Shape]:
        return (dict.fromkeys(self.form_parameters, 1.0),)

    def unit(self, context: Context) -> str:
        return "1/s"

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        offset = zero_of(context.unit_of("own"))
        around = (context.part(SURROUNDINGS) + offset).pow(4) if SURROUNDINGS in shape else ROOM**4
        return -((context.part("own") + offset).pow(4) - around) / (4.0 * ROOM**3)

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        around = f"({names[SURROUNDINGS]} + {names['zero']})" if SURROUNDINGS in shape else f"{ROOM!r}"
        return (f"-{gamma[0]!r} * (({names['own']} + {names['zero']}) ** 4 - {around} ** 4) / (4.0 * {ROOM!r}**3)",)
