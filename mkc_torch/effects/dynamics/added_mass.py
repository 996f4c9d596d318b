"""Fluid that has to be accelerated too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.dynamics.rate import RateEffect

if TYPE_CHECKING:
    from jaxtyping import Float


class AddedMass(RateEffect):
    """A body in a fluid moves some of it along: all forces together accelerate more than the body's own mass.

    It is told from the simulation's own parameters by what these cannot scale, such as gravity or a known force; where
    they scale everything, as a mass or an inertia of the simulation's own does, nothing is left of it.

    Simulation: adds ``−γ f`` to the rate of a speed, f what the simulation's own equations give for it; γ is the
        fluid's share of all the mass, ``m_a / (m + m_a)``.
    Drivers: none but the states and inputs.
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
    explanation = "Everything that accelerates the body does so too much: fluid that moves along adds to its mass."
    advice = "Add the mass of the fluid that moves along, this share of all the mass."
    source = "Lamb, Hydrodynamics (1932), art. 92; Brennen, A Review of Added Mass and Fluid Inertial Forces (1982)"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:  # noqa: ARG002
        return (Quantity(self.gain, 1, ""),)

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:  # noqa: ARG002
        return -context.part("rate")

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:  # noqa: ARG002
        return (f"-{gamma[0]!r} * {names['rate']}",)
