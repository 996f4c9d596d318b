"""A stop that limits the position."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.dynamics.rate import RateEffect, beyond

if TYPE_CHECKING:
    from jaxtyping import Float


PLACES = (0.5, 0.65, 0.8, 0.9)
"""Positions of the stop to search, as shares of the largest deflection."""


class HardStop(RateEffect):
    """A bumper or an end stop: beyond a position a stiff spring acts against the motion.

    Simulation: adds ``−γ₁ h (h/c)ⁿ⁻¹`` with ``h = max(x − c, 0)``, and γ₂ on the other side, to the rate of the speed
        whose position is x. The exponent n is 1 for a spring and 3/2 for a ball on a plate; it is 1 in the search and
        fitted afterwards.
    Drivers: the position only.
    Units: γ in the speed's unit per s and unit of position; the shape ``place`` in the unit of the position;
        ``exponent`` is a number.
    Plausible: γ ≥ 0.
    Source: penalty contact; Gilardi & Sharf, Mechanism and Machine Theory 37 (2002).
    """

    id = "hard_stop"
    relative: Mapping[str, tuple[str, str]] = {"place": ("position", "largest")}
    fitted_shape: Mapping[str, tuple[float, float]] = {"place": (0.4, 0.98), "exponent": (1.0, 3.0)}
    natural_ends: Mapping[str, tuple[str, ...]] = {"exponent": ("least",)}
    needs = ("position",)
    gain = "stiffness"
    plot_axis = "position"
    power = 1.0
    equation = "δv̇ = −γ₁ h (h/c)ⁿ⁻¹ + γ₂ h' (h'/c)ⁿ⁻¹,  h = max(x − c, 0), h' = max(−c − x, 0)"
    explanation = "The motion runs into a stop: beyond a position a force acts against it."
    advice = "Add a stop at this position."
    source = "penalty contact; Gilardi & Sharf (2002)"

    def shapes(self, time: object) -> Sequence[Shape]:
        return tuple({"place": place, "exponent": 1.0} for place in PLACES)

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity("upper_stiffness", 1, self.unit(context)), Quantity("lower_stiffness", 1, self.unit(context)))

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N 1"]:
        x, place, exponent = context.part("position"), shape["place"], shape["exponent"]
        forces = torch.stack([-beyond(x, place, exponent), beyond(-x, place, exponent)], -1)
        return (forces @ gamma).unsqueeze(-1)

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        x, place, exponent = names["position"], shape["place"], shape["exponent"]
        below = f"{gamma[1]!r} * beyond(-{x}, {place!r}, {exponent!r})"
        return (f"-{gamma[0]!r} * beyond({x}, {place!r}, {exponent!r}) + {below}",)
