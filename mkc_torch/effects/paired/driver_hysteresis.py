"""Hysteresis of an output, driven by a column: the models of Bouc and Wen, and of Dahl."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.unit_text import quotient
from mkc_torch.effects.base import GainEffect
from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.hysteresis import hysteretic_path
from mkc_torch.effects.runs import first_of_runs, linear_recurrence

if TYPE_CHECKING:
    from jaxtyping import Float, Int

YIELDS = (0.02, 0.03, 0.045, 0.065, 0.09, 0.12, 0.16, 0.21, 0.28, 0.38, 0.5)
"""Deflections at which the force yields, as shares of the largest value of the column, less its mean.

Dense, because the search compares both models on this grid: a coarse one prefers the model with a point near its best.
"""

_SHORT = 1e-12
"""Path length over the yield deflection below which its exponential is replaced by its limit."""


class DriverBoucWen(GainEffect):
    """The output depends on the path of a column in a loop: elastic after each reversal, then yielding.

    Simulation: adds ``γ z`` to an output, with ``dz = dx − (|dx| z + dx |z|) / (2 z₀)`` and z = 0 at the start of each
        run: the Bouc-Wen model of a mount, a magnet or a joint as a function of its deflection x.
    Drivers: any column, inputs of the simulation too, with its history since the start of the run.
    Units: γ in the output's unit per unit of the column; the shape ``yield_deflection``, z₀, in the column's unit.
    Plausible: either sign.
    Source: Wen, Journal of the Engineering Mechanics Division 102 (1976), n = 1; Ismail, Ikhouane & Rodellar,
        "The Hysteresis Bouc-Wen Model, a Survey", Archives of Computational Methods in Engineering 16 (2009).
    """

    id = "driver_bouc_wen"
    display_name = "Bouc-Wen hysteresis of a column"
    port = "output"
    needs = ("own", "compared")
    remembers = True
    roles: tuple[str, ...] = ("any", "current", "input")
    relative: Mapping[str, tuple[str, str]] = {"yield_deflection": ("driver", "largest")}
    fitted_shape: Mapping[str, tuple[float, float]] = {"yield_deflection": (0.01, 2.0)}
    gain = "stiffness"
    equation = "δy = γ z,  dz = dx − (|dx| z + dx |z|) / (2 z₀)"
    explanation = "The output depends on the path of this column: it follows a loop that is elastic after a reversal."
    advice = "Add a hysteretic part that yields at this deflection."
    source = "Wen (1976); Ismail, Ikhouane & Rodellar, The Hysteresis Bouc-Wen Model, a Survey (2009)"

    def shapes(self, time: object) -> Sequence[Shape]:
        return tuple({"yield_deflection": share} for share in YIELDS)

    def unit(self, context: Context) -> str:
        return quotient(context.signal_unit, context.units[0])

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        return hysteretic_path(context.drivers[:, 0], shape["yield_deflection"], context.runs)


class DriverDahl(DriverBoucWen):
    """The output has dry friction with presliding of a column's path: after a reversal it approaches its level.

    Simulation: adds ``γ z`` to an output, with ``dz = dx − |dx| z / z₀`` and z = 0 at the start of each run: Dahl's
        model ``dF/dx = σ (1 − F sgn(ẋ) / F_c)`` with γ = σ and z₀ = F_c / σ.
    Drivers: any column, inputs of the simulation too, with its history since the start of the run.
    Units: γ in the output's unit per unit of the column; the shape ``yield_deflection``, z₀, in the column's unit.
    Plausible: either sign.
    Source: Dahl, "Solid friction damping of mechanical vibrations", AIAA Journal 14 (1976), 1675.
    """

    id = "driver_dahl"
    display_name = "Dahl friction of a column"
    equation = "δy = γ z,  dz = dx − |dx| z / z₀"
    explanation = "The output follows the direction in which this column moves, with a soft change after each reversal."
    advice = "Add Dahl friction of this stiffness, whose level is the stiffness times this deflection."
    source = "Dahl, AIAA Journal 14 (1976), 1675"

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        return dahl_path(context.drivers[:, 0], shape["yield_deflection"], context.runs)


def dahl_path(position: Float[Tensor, " N"], yields: float | Tensor, run: Int[Tensor, " N"]) -> Float[Tensor, " N"]:
    """The internal state z of Dahl's model along a known path of the position, from 0 at the start of each run.

    Between samples the position moves one way, so z is exact: ``dz = dx − |dx| z / z₀`` is linear.

    Args:
        position: positions at the samples.
        yields: the deflection z₀ that z approaches, in the position's unit; positive.
        run: number of each sample's run.

    Example:
        After a long way up z is z₀, after a long way down −z₀:

        >>> there_and_back = torch.tensor([0.0, 50.0, 0.0]).double()
        >>> dahl_path(there_and_back, 1.0, torch.zeros(3, dtype=torch.long))
        tensor([ 0.,  1., -1.], dtype=torch.float64)
    """
    travel = torch.cat([torch.zeros_like(position[:1]), position.diff()])
    travel = torch.where(first_of_runs(run), 0.0, travel)
    slope = travel.abs() / yields
    keep = torch.where(first_of_runs(run), 0.0, torch.exp(-slope))
    gain = torch.where(slope > _SHORT, -torch.expm1(-slope) / slope.clamp(min=_SHORT), 1.0)
    return linear_recurrence(keep, travel * gain)
