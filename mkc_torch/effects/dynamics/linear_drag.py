"""Drag in proportion to the speed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.dynamics.rate import RateEffect

if TYPE_CHECKING:
    from jaxtyping import Float


class LinearDrag(RateEffect):
    """Viscous friction or a leak: the state loses in proportion to itself.

    Simulation: adds ``−γ x`` to the rate of a state x.
    Drivers: none but the state.
    Units: γ in 1/s.
    Plausible: γ ≥ 0; a negative drag would feed energy in.
    Source: Stokes' law of drag at small Reynolds numbers; viscous friction of bearings.
    """

    id = "linear_drag"
    gain = "drag"
    power = 1.0
    equation = "δẋ = −γ x"
    explanation = "The motion is damped in proportion to its speed, as by a viscous fluid."
    advice = "Add viscous drag with this coefficient."
    source = "Stokes' law at small Reynolds numbers; viscous friction of bearings"

    def course(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:  # noqa: ARG002
        return -context.part("own")

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:  # noqa: ARG002
        return (f"-{gamma[0]!r} * {names['own']}",)
