"""A rate constant that depends on a recorded column."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch._support.unit_text import quotient
from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.dynamics.rate import SURROUNDINGS, RateEffect, second_mass
from mkc_torch.effects.kinds import MOTION
from mkc_torch.effects.waveforms import per

if TYPE_CHECKING:
    from jaxtyping import Float


class DriverRateConstant(RateEffect):
    """A loss or a damping depends on a recorded column: cooling on the wind, a reaction or a bearing on temperature.

    Simulation: adds ``−γ (d − d̄) x`` to the rate of a state x, or ``−γ (d − d̄) (x − u)`` where an input u is its
        surroundings; d̄ is the column's mean.
    Drivers: any column.
    Units: γ in 1/s per unit of the column.
    Plausible: either sign.
    Source: Incropera et al., "Fundamentals of Heat and Mass Transfer" (2007), 7; Arrhenius' law, to first order.

    Args:
        to_surroundings: whether it is proportional to the difference from the surroundings.
    """

    id = "driver_rate_constant"
    display_name = "rate constant that depends on a column"
    roles: tuple[str, ...] = ("any", "temperature", "current")
    lower = -math.inf
    gain = "per_unit"
    equation = "δẋ = −γ (d − d̄) x"
    explanation = "The state is lost in proportion to itself, by a factor that depends on this column."
    advice = "Let the coefficient of the loss depend on the column, and fit it again."
    display_name_by_kind: Mapping[str, str] = {
        **dict.fromkeys(MOTION, "damping that depends on a column"),
        "temperature": "loss of heat that depends on a column",
        "level": "leak that depends on a column",
        "pressure": "leak that depends on a column",
        "voltage": "leak of charge that depends on a column",
        "current": "resistance that depends on a column",
    }
    by_kind: Mapping[str, tuple[str, str]] = dict.fromkeys(
        MOTION,
        (
            "The motion is damped in proportion to its speed, by a factor that depends on this column.",
            "Let the damping depend on the column, and fit it again.",
        ),
    )
    source = "Incropera et al., Fundamentals of Heat and Mass Transfer (2007), 7; Arrhenius' law, to first order"

    def __init__(self, *, to_surroundings: bool = False) -> None:
        if to_surroundings:
            self.needs, self.form_parameters = ("own", SURROUNDINGS), (SURROUNDINGS,)
            self.equation = "δẋ = −γ (d − d̄) (x − u)"
            self.by_kind = {}
            self.explanation = "The exchange with the surroundings depends on this column."
            self.advice = "Let the coefficient of the exchange depend on the column, and fit it again."

    def shapes(self, time: object) -> Sequence[Shape]:
        return (dict.fromkeys(self.form_parameters, 1.0),)

    def unit(self, context: Context) -> str:
        # at a force the loss is one of it per speed
        loss = quotient(context.signal_unit, context.unit_of("own")) if second_mass(context).unit else "1/s"
        return per(loss, f"({context.units[0]})" if "/" in context.units[0] else context.units[0])

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        own = context.part("own")
        return -context.drivers[:, 0] * (own - context.part(SURROUNDINGS) if SURROUNDINGS in shape else own)

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        own = names["own"]
        of = f"({own} - {names[SURROUNDINGS]})" if SURROUNDINGS in shape else own
        return (f"-{gamma[0]!r} * {names['driver']} * {of}",)
