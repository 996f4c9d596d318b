"""Dry friction that grows with the load."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.dynamics.coulomb_friction import CoulombFriction

if TYPE_CHECKING:
    from jaxtyping import Float


class LoadDependentFriction(CoulombFriction):
    """Dry friction of a gear: a constant part, and a part in proportion to the load on the teeth.

    Simulation: adds ``−(γ₁ + γ₂ |a − h|) tanh(v / w)`` to the rate of a speed v, where a is the contribution of the
    inputs at this speed, including a motor's braking field, and h the rate at standstill without inputs.
    Drivers: the states and inputs only.
    Units: γ₁ in the speed's unit per s; γ₂ is a share; ``width`` in the unit of the speed.
    Plausible: γ ≥ 0.
    Source: Duclusaud et al., "Extended Friction Models for the Physics Simulation of Servo Actuators", ICRA 2025.
    """

    id = "load_dependent_friction"
    port = "loaded rate"
    reduces_to = CoulombFriction()
    needs = ("reversing", "load")  # at speeds of one sign it is a constant force
    equation = "δv̇ = −(γ₁ + γ₂ |a − h|) tanh(v / w)"
    explanation = "Dry friction opposes the motion, the more the larger the load of the drive."
    advice = "Add dry friction with a part in proportion to the load."
    source = "Duclusaud et al., Extended Friction Models for the Physics Simulation of Servo Actuators, ICRA 2025"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity("friction", 1, context.signal_unit), Quantity("share_of_load", 1, ""))

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N 1"]:
        against = -torch.tanh(context.part("own") / shape["width"])
        return (against * (gamma[0] + gamma[1] * context.part("load"))).unsqueeze(-1)

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        size = f"({gamma[0]!r} + {gamma[1]!r} * {names['load']})"
        return (f"-{size} * torch.tanh({names['own']} / {shape['width']!r})",)
