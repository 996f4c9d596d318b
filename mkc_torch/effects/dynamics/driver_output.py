"""A recorded column that acts on an output of the simulation, linearly."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.base import GainEffect
from mkc_torch.effects.context import Context, Shape

if TYPE_CHECKING:
    from jaxtyping import Float

ROLES = ("any", "temperature", "current")
"""Roles of the columns that an output can depend on."""

ADVICE = "Correct the output by the column, if it is a cause of the change and not a consequence."


class DriverOutput(GainEffect):
    """An output depends on a recorded column: a gauge on temperature, a sensor on its supply, a level on a river.

    Simulation: adds ``γ (d − d̄)`` to one output of differential equations; d̄ is the column's mean. A column that acts
    on two outputs is two effects, so that a column of one sensor is not charged with the numbers of all others. For
    other simulations see :class:`mkc_torch.effects.paired.driver_linear.DriverLinear`.
    Drivers: any column.
    Units: γ in the output's unit per unit of the column.
    Plausible: any size, either sign.
    Source: modifying and interfering inputs of sensors; Doebelin, "Measurement Systems" (2003), 2.3.
    """

    id = "driver_output"
    display_name = "output that depends on a column"
    port = "single output"
    needs: tuple[str, ...] = ("own",)
    roles: tuple[str, ...] = ROLES
    gain = "per_unit"
    equation = "δy = γ (d − d̄)"
    explanation = "The measured output depends on this column."
    advice = ADVICE
    source = "interfering inputs of sensors; Doebelin, Measurement Systems (2003), 2.3"

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        return context.drivers[:, 0]

    def code(self, gamma: Sequence[float], shape: Shape, names: Mapping[str, str]) -> tuple[str, ...]:
        return (f"{gamma[0]!r} * {names['driver']}",)
