"""Drag in proportion to the speed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.dynamics.rate import SURROUNDINGS, RateEffect

if TYPE_CHECKING:
    from jaxtyping import Float


class LinearDrag(RateEffect):
    """Viscous friction or a leak: the state decays in proportion to itself.

    Simulation: adds ``−γ x`` to the rate of a state x, or ``−γ (x − u)`` where an input u is its surroundings.
    Drivers: the state only.
    Units: γ in 1/s.
    Plausible: γ ≥ 0; a negative drag would feed energy in.
    Source: Stokes' law of drag at small Reynolds numbers; viscous friction of bearings; Newton's law of cooling.

    Args:
        to_surroundings: whether it is proportional to the difference from the surroundings.
    """

    id = "linear_drag"
    gain = "drag"
    power = 1.0
    equation = "δẋ = −γ x"
    explanation = "The motion is damped in proportion to its speed, as by a viscous fluid."
    advice = "Add viscous drag with this coefficient."
    display_name_by_kind: Mapping[str, str] = {
        "temperature": "loss of heat",
        "level": "leak",
        "pressure": "leak",
        "voltage": "leak of charge",
        "current": "resistance",
    }
    by_kind: Mapping[str, tuple[str, str]] = {
        "temperature": (
            "Heat is lost in proportion to the temperature.",
            "Add a loss of heat with this coefficient, and check the temperature that losses are counted from.",
        ),
        "level": ("The level falls in proportion to itself, as by a leak.", "Add a leak with this coefficient."),
        "voltage": (
            "The charge leaks in proportion to the voltage.",
            "Add a resistor in parallel with this coefficient, 1 / (R C).",
        ),
        "current": ("The current dies away in proportion to itself.", "Add a resistance with this coefficient, R / L."),
        "": (
            "The state decays in proportion to itself.",
            "Add a loss in proportion to the state, with this coefficient.",
        ),
        "pressure": ("The pressure falls in proportion to itself, as by a leak.", "Add a leak with this coefficient."),
    }
    source = "Stokes' law at small Reynolds numbers; viscous friction of bearings"

    def __init__(self, *, to_surroundings: bool = False) -> None:
        if to_surroundings:
            self.needs, self.form_parameters = ("own", SURROUNDINGS), (SURROUNDINGS,)
            self.equation = "δẋ = −γ (x − u)"
            self.explanation = "The state approaches its surroundings, in proportion to the difference."
            self.advice = "Add a loss to the surroundings with this coefficient."
            self.by_kind = {}

    def shapes(self, time: object) -> Sequence[Shape]:
        return (dict.fromkeys(self.form_parameters, 1.0),)

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        return -(context.part("own") - context.part(SURROUNDINGS) if SURROUNDINGS in shape else context.part("own"))

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        own = names["own"]
        return (f"-{gamma[0]!r} * " + (f"({own} - {names[SURROUNDINGS]})" if SURROUNDINGS in shape else own),)
