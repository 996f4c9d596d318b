"""Inertia of the fluid that a body moves along."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.dynamics.rate import RateEffect

if TYPE_CHECKING:
    from jaxtyping import Float


class AddedMass(RateEffect):
    """Fluid that a body moves along adds to its inertia.

    Terms that the simulation's parameters cannot scale, such as gravity or a known force, distinguish it from these
    parameters; if they scale all terms, as a mass or an inertia does, it is not identifiable.

    Simulation: adds ``−γ f`` to the rate of a speed, where f is the rate by the simulation's equations; γ is the
        fluid's share of the total mass, ``m_a / (m + m_a)``.
    Drivers: the states and inputs only.
    Units: γ is a share.
    Plausible: γ from 0 to 1; half the displaced fluid's mass for a sphere, all of it for a cylinder across the flow.
    Source: Lamb, "Hydrodynamics" (1932), art. 92; Brennen, "A Review of Added Mass and Fluid Inertial Forces" (1982).
    """

    id = "added_mass"
    needs = ("position", "rate")
    upper = 1.0
    plausible = 0.9
    gain = "share"
    plot_axis = "rate"
    equation = "δv̇ = −γ f,  γ = m_a / (m + m_a)"
    explanation = "All accelerations are simulated too large: fluid that moves along adds to the body's mass."
    advice = "Add the mass of the fluid that moves along, this share of the total mass."
    source = "Lamb, Hydrodynamics (1932), art. 92; Brennen, A Review of Added Mass and Fluid Inertial Forces (1982)"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity(self.gain, 1, ""),)

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        return -context.part("rate")

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        return (f"-{gamma[0]!r} * {names['rate']}",)
