"""A restoring force with hysteresis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.unit_text import quotient
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.dynamics.rate import RateEffect
from mkc_torch.effects.hysteresis import hysteretic_path

if TYPE_CHECKING:
    from jaxtyping import Float

YIELDS = (0.05, 0.1, 0.2, 0.4, 0.8)
"""Deflections at which the force yields, as shares of the largest deflection."""


class BoucWenHysteresis(RateEffect):
    """A force that is elastic after each reversal and then yields, in a loop: rubber, wire rope, joints, soil.

    Simulation: adds ``−γ z`` to the rate of the speed v of a position, with an internal state z that is 0 at the start
        of each run: the Bouc-Wen equation ``ż = A v − β |v| z − β′ v |z|`` with A = 1, which is absorbed in γ, and
        β = β′ = 1 / (2 z₀), so that unloading is elastic and |z| never exceeds z₀.
    Drivers: the position and its speed only, with their history since the start of the run.
    Units: γ in the speed's unit per s and unit of position; the shape ``yield_deflection``, z₀, in that of position.
    Plausible: γ ≥ 0: a loop dissipates energy.
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
    explanation = "The restoring force depends on the path of the position: it yields, and follows a hysteresis loop."
    advice = "Add a hysteretic spring that yields at this deflection."
    source = "Wen (1976); Ismail, Ikhouane & Rodellar, The Hysteresis Bouc-Wen Model, a Survey (2009)"

    def shapes(self, time: object) -> Sequence[Shape]:
        return tuple({"yield_deflection": share} for share in YIELDS)

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity(self.gain, 1, quotient(context.signal_unit, context.unit_of("position")) or "1/s²"),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        """The force and, while a trajectory is solved, the rate of z, (N, 2); else along the known path, (N, 1)."""
        z, yields = context.memory, shape["yield_deflection"]
        if z is None:
            z = hysteretic_path(context.part("position"), yields, context.runs)
            return (-gamma[0] * z).unsqueeze(-1)
        v = context.part("own")
        return torch.stack([-gamma[0] * z, v - (v.abs() * z + v * z.abs()) / (2.0 * yields)], -1)

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        v, z, twice = names["own"], names["memory"], 2.0 * shape["yield_deflection"]
        return f"-{gamma[0]!r} * {z}", f"{v} - ({v}.abs() * {z} + {v} * {z}.abs()) / {twice!r}"
