"""The end of the way."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.dynamics.rate import RateEffect
from mkc_torch.effects.protocol import Context, Quantity, Shape

if TYPE_CHECKING:
    from jaxtyping import Float


PLACES = (0.5, 0.65, 0.8, 0.9)
"""Of the stop, as shares of the largest deflection."""


class HardStop(RateEffect):
    """A bumper or the end of the way: beyond a place a stiff spring pushes back.

    Simulation: adds ``−γ₁ max(x − c, 0) + γ₂ max(−c − x, 0)`` to the rate of the speed whose position is x.
    Drivers: none but the position.
    Units: γ in the speed's unit per s and unit of position; the shape ``place`` in the unit of what it is of.
    Plausible: γ ≥ 0.
    Source: penalty contact; Gilardi & Sharf, Mechanism and Machine Theory 37 (2002).
    """

    id = "hard_stop"
    relative: Mapping[str, tuple[str, str]] = {"place": ("position", "largest")}
    fitted_shape: Mapping[str, tuple[float, float]] = {"place": (0.4, 0.98)}
    needs = ("position",)
    gain = "stiffness"
    of = "position"
    power = 1.0
    equation = "δv̇ = −γ₁ max(x − c, 0) + γ₂ max(−c − x, 0)"
    explanation = "The motion runs into a stop: beyond a place something pushes back."
    advice = "Add a stop at this place."
    source = "penalty contact; Gilardi & Sharf (2002)"

    def shapes(self, time: object) -> Sequence[Shape]:  # noqa: ARG002
        return tuple({"place": place} for place in PLACES)

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:  # noqa: ARG002
        return (Quantity("upper_stiffness", 1, self.unit(context)), Quantity("lower_stiffness", 1, self.unit(context)))

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N 1"]:
        x, place = context.part("position"), shape["place"]
        push = torch.stack([-(x - place).clamp(min=0.0), (-place - x).clamp(min=0.0)], -1)
        return (push @ gamma).unsqueeze(-1)

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        x, place = names["position"], shape["place"]
        below = f"{gamma[1]!r} * (-{place!r} - {x}).clamp(min=0.0)"
        return (f"-{gamma[0]!r} * ({x} - {place!r}).clamp(min=0.0) + {below}",)
