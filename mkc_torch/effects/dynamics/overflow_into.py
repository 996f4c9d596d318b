"""Overflow of a vessel, a part of which another vessel catches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.dynamics.overflow import Overflow
from mkc_torch.effects.dynamics.rate import beyond

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["OverflowInto"]


class OverflowInto(Overflow):
    """A vessel overflows above its rim, in part into another vessel, which comes later in the simulation's states.

    Simulation: adds ``−γ₁ h (h/c)ⁿ⁻¹`` with ``h = max(x − c, 0)`` to the rate of a level x, and ``γ₂ h (h/c)ⁿ⁻¹`` to
        the rate of a level y; γ₂ is less than γ₁ where a part is lost, or where the vessel of y is wider.
    Drivers: the states only.
    Units: γ in 1/s; the rim in the unit of the level; ``exponent`` is a number.
    Plausible: γ ≥ 0.
    Source: cascaded tanks; Schoukens, Mattson, Wigren & Noël, Workshop on Nonlinear System Identification Benchmarks
        (2016).
    """

    port = "exchange"
    needs: tuple[str, ...] = ("level", "other level")
    equation = "δẋ = −γ₁ h (h/c)ⁿ⁻¹,  δẏ = γ₂ h (h/c)ⁿ⁻¹,  h = max(x − c, 0)"
    explanation = "There is a loss above a level, as when a vessel overflows, and a part of it reaches another vessel."
    advice = "Add a loss above this level, and an inflow of the other vessel in proportion to it."
    source = "cascaded tanks; Schoukens et al., Workshop on Nonlinear System Identification Benchmarks (2016)"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity("loss", 1, "1/s"), Quantity("inflow", 1, "1/s"))

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N 2"]:
        over = beyond(context.part("own"), shape["rim"], shape["exponent"])
        return torch.stack([-gamma[0] * over, gamma[1] * over], -1)

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        over = f"beyond({names['own']}, {shape['rim']!r}, {shape['exponent']!r})"
        return f"-{gamma[0]!r} * {over}", f"{gamma[1]!r} * {over}"
