"""Heat that is radiated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.dynamics.rate import RateEffect

if TYPE_CHECKING:
    from jaxtyping import Float


ZERO = 273.15


class ThermalLoss(RateEffect):
    """A body loses heat by radiation, with the fourth power of its temperature.

    Simulation: adds ``−γ (T⁴ − T₀⁴) / (4 T₀³)`` to the rate of a temperature, T absolute and T₀ 293 K.
    Drivers: none but the state.
    Units: γ in 1/s, as of a linear loss near T₀.
    Plausible: γ ≥ 0.
    Source: Stefan and Boltzmann's law.
    """

    id = "thermal_loss"
    needs = ("own", "temperature")
    gain = "loss"
    equation = "δṪ = −γ (T⁴ − T₀⁴) / (4 T₀³)"
    explanation = "The body loses heat with the fourth power of its absolute temperature: it radiates."
    advice = "Add radiation with this coefficient."
    source = "Stefan and Boltzmann's law"

    def unit(self, context: Context) -> str:  # noqa: ARG002
        return "1/s"

    def course(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:  # noqa: ARG002
        offset = ZERO if context.unit_of("own") == "°C" else 0.0
        room = 293.15
        return -((context.part("own") + offset).pow(4) - room**4) / (4.0 * room**3)

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:  # noqa: ARG002
        return (f"-{gamma[0]!r} * (({names['own']} + {names['zero']}) ** 4 - 293.15**4) / (4.0 * 293.15**3)",)
