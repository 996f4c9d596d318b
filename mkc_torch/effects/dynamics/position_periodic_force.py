"""A force that repeats with the position."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.unit_text import sized
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.dynamics.rate import RateEffect

if TYPE_CHECKING:
    from jaxtyping import Float


ORDERS = (1, 2, 3, 4, 6, 8, 12, 24)
"""Numbers of periods per turn to search."""


class PositionPeriodicForce(RateEffect):
    """Cogging and eccentricity: a force that repeats with each turn or an integer fraction of a turn.

    Simulation: adds ``γ₁ sin(k x) + γ₂ cos(k x)`` to the rate of the speed whose angle is x.
    Drivers: the position only.
    Units: γ in the speed's unit per s; x in rad.
    Plausible: either sign.
    Source: Hanselman, "Brushless Permanent Magnet Motor Design" (2003), ch. 9.
    """

    id = "position_periodic_force"
    needs = ("angle",)
    lower = -math.inf
    gain = "amplitude"
    plot_axis = "angle"
    equation = "δv̇ = γ₁ sin(k x) + γ₂ cos(k x)"
    explanation = "A force repeats with the position, as the cogging of a motor or an eccentric weight does."
    advice = "Add a force with this number of periods a turn."
    form_parameters = ("order",)
    source = "Hanselman, Brushless Permanent Magnet Motor Design (2003)"

    def equation_of(self, shape: Shape, context: Context) -> str:
        return f"{self.equation},  k = {sized(shape['order'])}, periods in a turn"

    def components(self, quantity: str, shape: Shape, context: Context) -> tuple[str, ...]:
        phase = _phase(shape)
        return (f"sin({phase})", f"cos({phase})")

    def advised(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        if shape["order"] == 1.0:
            return "Add a force with one period a turn: gravity on an unbalanced load, or an eccentric load."
        return self.advice

    def shapes(self, time: object) -> Sequence[Shape]:
        return tuple({"order": float(order)} for order in ORDERS)

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity(self.gain, 2, self.unit(context)),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N 1"]:
        phase = shape["order"] * context.part("angle")
        return (torch.stack([phase.sin(), phase.cos()], -1) @ gamma).unsqueeze(-1)

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        phase = f"{shape['order']!r} * {names['angle']}"
        return (f"{gamma[0]!r} * torch.sin({phase}) + {gamma[1]!r} * torch.cos({phase})",)


def _phase(shape: Shape) -> str:
    return "x" if shape["order"] == 1.0 else f"{sized(shape['order'])} x"
