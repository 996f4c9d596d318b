"""Dry friction that is larger at standstill."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.dynamics.coulomb_friction import CoulombFriction

if TYPE_CHECKING:
    from jaxtyping import Float


SPEEDS = (0.1, 0.3, 1.0)
"""Stribeck speeds to search, below which friction grows, as shares of the typical speed."""


class StribeckFriction(CoulombFriction):
    """Dry friction that grows at small speeds, where the lubricant's film breaks down.

    Simulation: adds ``−(γ₁ + γ₂ exp(−(v/v_s)²)) tanh(v / w)`` to the rate of a speed v.
    Drivers: the state only.
    Units: γ in the speed's unit per s; ``width`` and ``stribeck_speed`` in the unit of the speed.
    Plausible: γ ≥ 0.
    Source: Stribeck, VDI-Zeitschrift 46 (1902); Armstrong-Hélouvry, "Control of Machines with Friction" (1991).
    """

    id = "stribeck_friction"
    relative: Mapping[str, tuple[str, str]] = {"width": ("own", "typical"), "stribeck_speed": ("own", "typical")}
    fitted_shape: Mapping[str, tuple[float, float]] = {"stribeck_speed": (0.05, 2.0)}
    reduces_to = CoulombFriction()
    equation = "δv̇ = −(γ₁ + γ₂ exp(−(v/v_s)²)) tanh(v / w)"
    explanation = "Dry friction opposes the motion, and is larger at small speeds."
    advice = "Add dry friction with a rise towards standstill."
    source = "Stribeck (1902); Armstrong-Hélouvry, Control of Machines with Friction (1991)"

    def shapes(self, time: object) -> Sequence[Shape]:
        return tuple({"width": width, "stribeck_speed": speed} for width in (0.1, 0.03) for speed in SPEEDS)

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity("friction", 1, context.signal_unit), Quantity("rise_at_rest", 1, context.signal_unit))

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N 1"]:
        own = context.part("own")
        rise = torch.exp(-(own / shape["stribeck_speed"]).square())
        against = -torch.tanh(own / shape["width"])
        return (against * (gamma[0] + gamma[1] * rise)).unsqueeze(-1)

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        own = names["own"]
        rise = f"{gamma[1]!r} * torch.exp(-(({own} / {shape['stribeck_speed']!r}) ** 2))"
        return (f"-({gamma[0]!r} + {rise}) * torch.tanh({own} / {shape['width']!r})",)
