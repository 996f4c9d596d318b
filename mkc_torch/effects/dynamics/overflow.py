"""Overflow of a vessel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.dynamics.rate import RateEffect, beyond

if TYPE_CHECKING:
    from jaxtyping import Float


RIMS = (0.5, 0.65, 0.8, 0.9)
"""Rims to search, as shares of the highest level."""


class Overflow(RateEffect):
    """A vessel overflows above its rim.

    Simulation: adds ``−γ h (h/c)ⁿ⁻¹`` with ``h = max(x − c, 0)`` to the rate of a level x. The exponent n is 3/2 for a
        wide weir and 5/2 for a V-notch; it is 1 in the search and fitted afterwards.
    Drivers: the state only.
    Units: γ in 1/s; the shape ``rim`` in the unit of the level; ``exponent`` is a number.
    Plausible: γ ≥ 0.
    Source: flow over weirs; Henderson, "Open Channel Flow" (1966), ch. 6.
    """

    id = "overflow"
    relative: Mapping[str, tuple[str, str]] = {"rim": ("own", "largest")}
    fitted_shape: Mapping[str, tuple[float, float]] = {"rim": (0.4, 0.98), "exponent": (1.0, 3.0)}
    natural_ends: Mapping[str, tuple[str, ...]] = {"exponent": ("least",)}
    needs: tuple[str, ...] = ("level",)
    gain = "loss"
    power = 1.0
    equation = "δẋ = −γ h (h/c)ⁿ⁻¹,  h = max(x − c, 0)"
    explanation = "There is a loss above a level, as when a vessel overflows."
    advice = "Add a loss above this level."
    source = "flow over weirs; Henderson, Open Channel Flow (1966)"

    def shapes(self, time: object) -> Sequence[Shape]:
        return tuple({"rim": rim, "exponent": 1.0} for rim in RIMS)

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        return -beyond(context.part("own"), shape["rim"], shape["exponent"])

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        return (f"-{gamma[0]!r} * beyond({names['own']}, {shape['rim']!r}, {shape['exponent']!r})",)
