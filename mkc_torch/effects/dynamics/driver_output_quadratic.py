"""A recorded column that acts on an output of the simulation by a parabola."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.unit_text import quotient
from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.dynamics.driver_output import ADVICE, ROLES, DriverOutput
from mkc_torch.effects.waveforms import apply_basis

if TYPE_CHECKING:
    from jaxtyping import Float


class DriverOutputQuadratic(Effect):
    """An output depends on a recorded column by a parabola, as a bridge that is balanced at one temperature does.

    Simulation: adds ``γ₁ (d − d̄) + γ₂ (d − d̄)²`` to one output of differential equations; d̄ is the column's mean.
    Drivers: any column.
    Units: γ₁ in the output's unit per unit of the column, γ₂ per square of that unit.
    Plausible: any size, either sign.
    Source: interfering inputs of sensors, to second order; Doebelin, "Measurement Systems" (2003), 2.3.
    """

    id = "driver_output_quadratic"
    display_name = "output that depends on a column by a parabola"
    port = "single output"
    needs: tuple[str, ...] = ("own",)
    roles: tuple[str, ...] = ROLES
    reduces_to = DriverOutput()
    equation = "δy = γ₁ (d − d̄) + γ₂ (d − d̄)²"
    explanation = "The measured output depends on this column by a parabola."
    advice = ADVICE
    source = "interfering inputs of sensors, to second order; Doebelin, Measurement Systems (2003), 2.3"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        slope = Quantity("per_unit", 1, DriverOutput().unit(context))
        return slope, Quantity("per_square", 1, quotient(context.signal_unit, context.units[0], 2))

    def basis(self, shape: Shape, context: Context) -> Float[Tensor, "N c q"]:
        column = context.drivers[:, 0]
        return torch.stack([column, column.square()], -1).unsqueeze(1)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        return apply_basis(self.basis(shape, context), gamma)

    def code(self, gamma: Sequence[float], shape: Shape, names: Mapping[str, str]) -> tuple[str, ...]:
        column = names["driver"]
        return (f"{gamma[0]!r} * {column} + {gamma[1]!r} * {column} ** 2",)
