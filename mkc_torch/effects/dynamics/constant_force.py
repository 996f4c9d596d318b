"""A constant force."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.dynamics.rate import RateEffect

if TYPE_CHECKING:
    from jaxtyping import Float


class ConstantForce(RateEffect):
    """A constant force that the simulation lacks: a bias, a slope of the ground, an unbalanced weight.

    Simulation: adds γ to the rate of a state.
    Drivers: none.
    Units: γ in the state's unit per s.
    Plausible: any size, either sign.
    Source: Newton's second law.
    """

    id = "constant_force"
    lower = -math.inf
    gain = "force"
    plot_axis = ""
    equation = "δẋ = γ"
    explanation = "A constant force acts."
    advice = "Look for a bias of the actuator, a tilted base, an unbalanced weight or buoyancy."
    display_name_by_kind: Mapping[str, str] = {
        "temperature": "constant heat flow",
        "level": "constant inflow",
        "pressure": "constant inflow",
        "voltage": "constant current",
        "current": "constant voltage",
    }
    by_kind: Mapping[str, tuple[str, str]] = {
        "temperature": (
            "A constant heat flow is added or removed.",
            "Look for a constant source or loss of heat, or for an error of a temperature that the simulation takes as "
            "known.",
        ),
        "level": (
            "There is a constant inflow or outflow.",
            "Look for a leak, an inflow that is not recorded, or a sensor's zero.",
        ),
        "voltage": ("A constant current charges or discharges.", "Look for a bias current, a leak or a sensor's zero."),
        "current": ("A constant voltage acts.", "Look for an offset voltage or a sensor's zero."),
        "": (
            "The state has a constant source or loss.",
            "Look for a source or a loss that is not recorded, a bias of an input, or a sensor's zero.",
        ),
        "pressure": (
            "There is a constant inflow or outflow.",
            "Look for a leak, an inflow that is not recorded, or a sensor's zero.",
        ),
    }
    source = "Newton's second law"

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        return torch.ones_like(context.time)

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        return (f"{gamma[0]!r}",)
