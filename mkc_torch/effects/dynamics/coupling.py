"""An exchange between two states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.dynamics.rate import RateEffect

if TYPE_CHECKING:
    from jaxtyping import Float


class Coupling(RateEffect):
    """Exchange between two states: heat between bodies, fluid between tanks, force between masses.

    Simulation: adds ``γ₁ (y − x)`` to the rate of a state x, and ``γ₂ (x − y)`` to the rate of a state y in the same
    unit; γ₁ = γ₂ between equal states.
    Drivers: the states only.
    Units: γ in 1/s.
    Plausible: γ ≥ 0: exchange reduces the difference.
    Source: Fourier's and Fick's laws; Hooke's law between masses.
    """

    id = "coupling"
    port = "exchange"
    needs = ("own", "other")
    gain = "exchange"
    plot_axis = "other"
    power = 1.0
    equation = "δẋ = γ₁ (y − x),  δẏ = γ₂ (x − y)"
    explanation = "The state exchanges with another state, in proportion to their difference."
    advice = "Couple the two states with this coefficient."
    source = "Fourier's law of conduction, Fick's law of diffusion"

    @property
    def simpler(self) -> Effect:
        return EqualCoupling()

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity(self.gain, 2, "1/s"),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N 2"]:
        away = context.part("other") - context.part("own")
        return torch.stack([gamma[0] * away, -gamma[-1] * away], -1)

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        away = f"({names['other']} - {names['own']})"
        return f"{gamma[0]!r} * {away}", f"-{gamma[-1]!r} * {away}"


class EqualCoupling(Coupling):
    """Exchange between equal states: what the first loses, the second gains."""

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity(self.gain, 1, "1/s"),)
