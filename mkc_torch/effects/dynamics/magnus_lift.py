"""Lift on a spinning body."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.dynamics.rate import RateEffect
from mkc_torch.effects.waveforms import per

if TYPE_CHECKING:
    from jaxtyping import Float


class MagnusLift(RateEffect):
    """A force on a spinning ball across its path, in proportion to spin and speed.

    The Coriolis force in a rotating frame and the Lorentz force on a charge have the same form; no recording
    distinguishes them.

    Simulation: adds ``−γ v_y`` to the rate of a speed v_x and ``γ v_x`` to the rate of a perpendicular speed v_y: it
        turns the path and takes no energy. Where the spin w is recorded, γ is ``γ₁ + γ₂ (w − w̄)`` with its mean w̄.
    Drivers: the states; a column whose name begins with ``spin``, if there is such a column.
    Units: γ, γ₁ in 1/s; γ₂ in 1/s per unit of the spin.
    Plausible: either sign.
    Source: Rayleigh (1877); Mehta, "Aerodynamics of Sports Balls", Annual Review of Fluid Mechanics 17 (1985).
    """

    id = "magnus_lift"
    port = "exchange"
    roles = ("spin",)
    driver_optional = True
    needs = ("own", "other", "sideways")
    lower = -math.inf
    gain = "turning"
    plot_axis = "other"
    equation = "δv̇_x = −γ v_y,  δv̇_y = γ v_x"
    explanation = "A force acts across the path, in proportion to the speed, as on a spinning ball in air."
    advice = "Add a force across the path with this coefficient, and record the spin."
    source = "Mehta, Aerodynamics of Sports Balls, Annual Review of Fluid Mechanics 17 (1985)"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        mean = Quantity(self.gain, 1, "1/s")
        if not context.units:
            return (mean,)
        unit = context.units[0]
        return mean, Quantity(f"{self.gain}_per_spin", 1, per("1/s", f"({unit})" if "/" in unit else unit))

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N 2"]:
        turning = gamma[0] + gamma[1] * context.drivers[:, 0] if context.units else gamma[0]
        return torch.stack([-turning * context.part("other"), turning * context.part("own")], -1)

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        turning = f"({gamma[0]!r} + {gamma[1]!r} * {names['driver']})" if len(gamma) > 1 else f"({gamma[0]!r})"
        return f"-{turning} * {names['other']}", f"{turning} * {names['own']}"
