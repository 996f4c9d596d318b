"""A parameter of the simulation that depends on a recorded temperature by Arrhenius' law."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.dynamics.driver_parameter import ADVICE, DriverParameter
from mkc_torch.effects.kinds import absolute_zero

if TYPE_CHECKING:
    from jaxtyping import Float


class DriverParameterArrhenius(Effect):
    """A parameter depends on a recorded temperature by Arrhenius' law: a cell's resistance, a viscosity, a reaction.

    Simulation: replaces a parameter p of differential equations by ``p exp(γ (1/T − 1/T̄))``; T is the column's absolute
    temperature and T̄ its mean.
    Drivers: a temperature. Without a unit it is in °C if its mean is below 150, otherwise in K.
    Units: γ in K; γ R is an activation energy, negative for a process that gets faster with temperature.
    Plausible: γ up to 15000 K, 125 kJ/mol.
    Source: Arrhenius' law; Atkins & de Paula, "Physical Chemistry" (2014), 20D; for viscosities Andrade, Nature 125
    (1930), 309.
    """

    id = "driver_parameter_arrhenius"
    display_name = "parameter that depends on temperature by Arrhenius' law"
    port = "parameter"
    follows_signal = True
    needs: tuple[str, ...] = ("own",)
    roles: tuple[str, ...] = ("temperature",)
    reduces_to = DriverParameter()
    lower, upper = -50_000.0, 50_000.0
    plausible = 15_000.0
    equation = "δp = p (exp(γ (1/T − 1/T̄)) − 1)"
    explanation = "The parameter depends on this temperature by Arrhenius' law."
    advice = ADVICE
    source = "Arrhenius' law; Atkins & de Paula, Physical Chemistry (2014), 20D"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity("exponent", 1, "K"),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        mean = context.driver_means[0] if context.driver_means else 0.0
        zero = absolute_zero(context.units[0], mean)
        inverse = 1.0 / (context.recorded + zero) - 1.0 / (mean + zero)
        return (context.part("own") * (torch.exp(gamma[0] * inverse) - 1.0)).unsqueeze(-1)

    def explained(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        column = f"`{context.columns[0]}`" if context.columns else "this temperature"
        return f"`{context.channels[0]}` depends on {column} by Arrhenius' law, with an exponent of {gamma[0]:.4g} K."

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        own, inverse = names["own"], f"1.0 / {names['absolute']} - 1.0 / {names['absolute_mean']}"
        return (f"{own} * (torch.exp({gamma[0]!r} * ({inverse})) - 1.0)",)
