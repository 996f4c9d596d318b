"""A parameter of the simulation that depends on a recorded temperature by Arrhenius' law."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.dynamics.driver_parameter import ADVICE, ROLES, DriverParameter, per_unit, slope_in_words
from mkc_torch.effects.kinds import Kind, absolute_zero

if TYPE_CHECKING:
    from jaxtyping import Float


class DriverParameterArrhenius(Effect):
    """A parameter depends on a recorded temperature by Arrhenius' law: a cell's resistance, a viscosity, a reaction.

    Simulation: replaces a parameter p of differential equations by ``p exp(γ (T − T̄) T̄/T)``; T is the column's absolute
    temperature and T̄ its mean. It is ``p exp(b (1/T − 1/T̄))`` with ``b = −γ T̄²``.
    Drivers: a temperature. Without a unit it is in °C if its mean is below 150, otherwise in K.
    Units: γ in 1/K, the relative change per K at the mean; b in K.
    Plausible: γ up to 0.15 1/K: b up to 13000 K near 300 K, an activation energy of 110 kJ/mol.
    Source: Arrhenius' law; Atkins & de Paula, "Physical Chemistry" (2014), 20D; for viscosities Andrade, Nature 125
    (1930), 309.
    """

    id = "driver_parameter_arrhenius"
    display_name = "parameter that depends on temperature by Arrhenius' law"
    port = "parameter"
    follows_signal = True
    needs: tuple[str, ...] = ("own",)
    roles: tuple[str, ...] = ROLES
    driver_kinds: tuple[Kind, ...] = ("temperature",)
    reduces_to = DriverParameter()
    lower, upper = -2.0, 2.0
    plausible = 0.15
    equation = "δp = p (exp(γ (T − T̄) T̄/T) − 1)"
    explanation = "The parameter depends on this temperature by Arrhenius' law."
    advice = ADVICE
    source = "Arrhenius' law; Atkins & de Paula, Physical Chemistry (2014), 20D"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity("per_unit", 1, per_unit(context)),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        mean = _absolute_mean(context)
        away = context.drivers[:, 0]
        return (context.part("own") * torch.expm1(gamma[0] * mean * away / (mean + away))).unsqueeze(-1)

    def explained(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        exponent = -gamma[0] * _absolute_mean(context) ** 2
        return f"{slope_in_words(gamma[0], context)} at its mean, by Arrhenius' law, exp({exponent:.4g} K (1/T − 1/T̄))."

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        share = f"{names['driver']} * {names['absolute_mean']} / ({names['absolute_mean']} + {names['driver']})"
        return (f"{names['own']} * torch.expm1({gamma[0]!r} * {share})",)


def _absolute_mean(context: Context) -> float:
    """The absolute mean temperature of the driver."""
    mean = context.driver_means[0] if context.driver_means else 0.0
    return mean + absolute_zero(context.units[0], mean)
