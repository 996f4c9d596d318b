"""A force in proportion to a recorded column."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.dynamics.rate import RateEffect
from mkc_torch.effects.kinds import MOTION
from mkc_torch.effects.waveforms import per

if TYPE_CHECKING:
    from jaxtyping import Float

_ADVICE = "Make the column an input of the simulation, if it is a cause of the change and not a consequence."


class DriverForce(RateEffect):
    """A force in proportion to a recorded column that the simulation does not use: a slope, sunshine, a load's current.

    Simulation: adds ``γ d`` to the rate of a state.
    Drivers: any column but temperatures, whose zero has no meaning; see :class:`DriverExchange`.
    Units: γ in the state's unit per s and per unit of the column.
    Plausible: any size, either sign.
    Source: Newton's second law and balances of heat, mass and charge, linear in the cause.
    """

    id = "driver_force"
    display_name = "source in proportion to a column"
    roles: tuple[str, ...] = ("any", "current")
    lower = -math.inf
    gain = "per_unit"
    plot_axis = ""
    equation = "δẋ = γ d"
    explanation = "The state has a source or a loss in proportion to this column."
    advice = _ADVICE
    display_name_by_kind: Mapping[str, str] = {
        **dict.fromkeys(MOTION, "force in proportion to a column"),
        "temperature": "heat flow in proportion to a column",
        "level": "flow in proportion to a column",
        "pressure": "flow in proportion to a column",
        "voltage": "current in proportion to a column",
        "current": "voltage in proportion to a column",
    }
    by_kind: Mapping[str, tuple[str, str]] = {
        kind: (f"{what} in proportion to this column.", _ADVICE)
        for kind, what in (
            *((kind, "A force acts") for kind in MOTION),
            ("temperature", "Heat flows in or out"),
            ("level", "Something flows in or out"),
            ("pressure", "Something flows in or out"),
            ("voltage", "A current charges or discharges"),
            ("current", "A voltage acts"),
        )
    }
    source = "balances of force, heat, mass and charge, linear in the cause"

    def unit(self, context: Context) -> str:
        return per(context.signal_unit, context.units[0])

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        return context.recorded

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        return (f"{gamma[0]!r} * {names['recorded']}",)
