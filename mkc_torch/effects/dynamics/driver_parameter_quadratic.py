"""A parameter of the simulation that depends on a recorded column by a parabola."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.dynamics.driver_parameter import ADVICE, ROLES, DriverParameter, per_unit, slope_in_words

if TYPE_CHECKING:
    from jaxtyping import Float


class DriverParameterQuadratic(Effect):
    """A parameter depends on a recorded column by a parabola, as an efficiency with an optimum does.

    Simulation: replaces a parameter p of differential equations by ``p (1 + γ₁ (d − d̄) + γ₂ (d − d̄)²)``; d̄ is the
    column's mean.
    Drivers: any column.
    Units: γ₁ per unit of the column, γ₂ per square of that unit.
    Plausible: any size, either sign.
    Source: the response to any cause, to second order; the resistance of platinum, IEC 60751.
    """

    id = "driver_parameter_quadratic"
    display_name = "parameter that depends on a column by a parabola"
    port = "parameter"
    follows_signal = True
    needs: tuple[str, ...] = ("own",)
    roles: tuple[str, ...] = ROLES
    reduces_to = DriverParameter()
    equation = "δp = (γ₁ (d − d̄) + γ₂ (d − d̄)²) p"
    explanation = "The parameter depends on this column by a parabola."
    advice = ADVICE
    source = "the response to any cause, to second order; the resistance of platinum, IEC 60751"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        unit = per_unit(context)
        return Quantity("per_unit", 1, unit), Quantity("per_square", 1, f"{unit}²" if unit else "")

    def basis(self, shape: Shape, context: Context) -> Float[Tensor, "N c q"]:
        column, own = context.drivers[:, 0], context.part("own")
        return torch.stack([column * own, column.square() * own], -1).unsqueeze(1)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        column, own = context.drivers[:, 0], context.part("own")
        return ((gamma[0] * column + gamma[1] * column.square()) * own).unsqueeze(-1)

    def explained(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        return f"{slope_in_words(gamma[0], context)} at the column's mean, and by a parabola."

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        column = names["driver"]
        return (f"({gamma[0]!r} * {column} + {gamma[1]!r} * {column} ** 2) * {names['own']}",)
