"""A restoring force that remembers the way it came."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.unit_text import quotient
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.dynamics.rate import RateEffect
from mkc_torch.effects.runs import first_of_runs, passed_on

if TYPE_CHECKING:
    from jaxtyping import Float, Int

__all__ = ["BoucWenHysteresis", "hysteretic_path"]

YIELDS = (0.05, 0.1, 0.2, 0.4, 0.8)
"""Deflections at which the force yields, as shares of the largest."""

_ROUNDS = 3
_SHORT = 1e-12


class BoucWenHysteresis(RateEffect):
    """A force that is elastic after each reversal, yields, and so goes round a loop: rubber, wire rope, joints, soil.

    Simulation: adds ``−γ z`` to the rate of the speed v of a position, with an internal state z of its own, 0 at the
        beginning of each run: Bouc and Wen's ``ż = A v − β |v| z − β′ v |z|`` with A = 1, which γ holds, and
        β = β′ = 1 / (2 z₀), so that it is elastic while it unloads and never exceeds z₀.
    Drivers: none but the position and its speed, all of their course since the run's beginning.
    Units: γ in the speed's unit per s and unit of position; the shape ``yield_deflection``, z₀, in that of position.
    Plausible: γ ≥ 0: a loop takes energy out.
    Source: Bouc (1967); Wen, Journal of the Engineering Mechanics Division 102 (1976), n = 1; Ismail, Ikhouane &
        Rodellar, "The Hysteresis Bouc-Wen Model, a Survey", Archives of Computational Methods in Engineering 16 (2009).
    """

    id = "bouc_wen_hysteresis"
    port = "hysteretic rate"
    relative: Mapping[str, tuple[str, str]] = {"yield_deflection": ("position", "largest")}
    fitted_shape: Mapping[str, tuple[float, float]] = {"yield_deflection": (0.02, 2.0)}
    needs = ("position", "reversing")  # without a reversal it is a spring that yields
    gain = "stiffness"
    plot_axis = "position"
    equation = "δv̇ = −γ z,  ż = v − (|v| z + v |z|) / (2 z₀)"
    explanation = "The restoring force depends on the way it came by: it yields, and goes round a loop."
    advice = "Add a hysteretic spring that yields at this deflection."
    source = "Wen (1976); Ismail, Ikhouane & Rodellar, The Hysteresis Bouc-Wen Model, a Survey (2009)"

    def shapes(self, time: object) -> Sequence[Shape]:  # noqa: ARG002
        return tuple({"yield_deflection": share} for share in YIELDS)

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:  # noqa: ARG002
        return (Quantity(self.gain, 1, quotient(context.signal_unit, context.unit_of("position")) or "1/s²"),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        """The force, and beside it the rate of z, where z is solved for; z along the known path, where it is not."""
        z, yields = context.memory, shape["yield_deflection"]
        if z is None:
            z = hysteretic_path(context.part("position"), yields, context.runs)
            return (-gamma[0] * z).unsqueeze(-1)
        v = context.part("own")
        return torch.stack([-gamma[0] * z, v - (v.abs() * z + v * z.abs()) / (2.0 * yields)], -1)

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        v, z, twice = names["own"], names["memory"], 2.0 * shape["yield_deflection"]
        return f"-{gamma[0]!r} * {z}", f"{v} - ({v}.abs() * {z} + {v} * {z}.abs()) / {twice!r}"


def hysteretic_path(position: Float[Tensor, " N"], yields: float, run: Int[Tensor, " N"]) -> Float[Tensor, " N"]:
    """The internal state z along a path that is known, from 0 at the first sample of each run.

    Between samples z follows from the way that was gone alone, and linearly while it has one sign: the signs are those
    of the solution before, from that of a path that relaxes whichever way it goes.

    Args:
        position: at the samples.
        yields: the deflection z₀ at which z yields, in the position's unit; positive.
        run: of each sample's run.

    Example:
        Loaded to twice its yield, and back by a half: 1 − e⁻² less the half, as it unloads elastically:

        >>> path = torch.cat([torch.linspace(0, 2, 2001), torch.linspace(2, 1.5, 501)]).double()
        >>> float(hysteretic_path(path, 1.0, torch.zeros(2502, dtype=torch.long))[-1])
        0.364...
    """
    way = torch.cat([torch.zeros_like(position[:1]), position.diff()])
    way = torch.where(first_of_runs(run), 0.0, way)
    relaxing = torch.full_like(way, 0.5)
    for _ in range(_ROUNDS):
        # while z goes back to 0 it is elastic
        slope = relaxing * way.abs() / yields
        factor = torch.where(first_of_runs(run), 0.0, torch.exp(-slope))
        gone = torch.where(slope > _SHORT, -torch.expm1(-slope) / slope.clamp(min=_SHORT), 1.0)
        z = passed_on(factor, way * gone)
        relaxing = (way * z > 0.0).to(way.dtype)
    return z
