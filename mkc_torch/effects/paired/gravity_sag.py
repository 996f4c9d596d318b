"""Sag of a joint under gravity."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import SEVERAL, Context, Quantity, Shape

if TYPE_CHECKING:
    from jaxtyping import Float

_PER_DEGREE = math.pi / 180.0


class GravitySag(Effect):
    """A joint sags under its load: most where the link is level, not at all where it hangs.

    A servo without integral action holds a load with a static error: the load's torque over its stiffness. Over a small
    range of angles a sag is indistinguishable from an offset, and the offset is preferred.

    Simulation: adds ``γ cos(y − φ)`` to an output y that is an angle.
    Drivers: the output only.
    Units: γ in the output's unit; φ, the parameter ``phase``, is the angle at which the link is level, within
        ±1 rad; beyond, a sag would be equivalent to a scale error.
    Plausible: up to 0.5 rad.
    Source: static error of a proportional joint controller under gravity; Spong, Hutchinson & Vidyasagar, "Robot
        Modeling and Control" (2006), 8.1.
    """

    id = "gravity_sag"
    port = "output"
    needs: tuple[str, ...] = ("own", "compared", "angle")
    follows_signal = True
    is_generalisation = True
    fitted_shape: Mapping[str, tuple[float, float]] = {"phase": (-1.0, 1.0)}
    natural_ends: Mapping[str, tuple[str, ...]] = {"phase": ("least", "greatest")}
    shape_units: Mapping[str, str] = {"phase": "rad"}
    plausible = 0.5
    plausible_unit = "rad"
    equation = "δy = γ cos(y − φ)"
    explanation = "Gravity deflects the joint, by an amount that depends on its angle: it sags under its load."
    advice = "Add the load's torque over the joint's stiffness, or feed gravity forward in its controller."
    recurrence = "a sag changes over a wide range of angles and with the load, an offset does not"
    source = "Spong, Hutchinson & Vidyasagar, Robot Modeling and Control (2006), 8.1"

    def shapes(self, time: object) -> Sequence[Shape]:
        return tuple({"phase": phase} for phase in (0.0, -0.7, 0.7))

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity("sag", len(context.channels), context.signal_unit),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        angle = context.signal * (_PER_DEGREE if context.signal_unit == "°" else 1.0)
        return gamma * torch.cos(angle - shape["phase"])


class SeveralSag(GravitySag):
    """A sag of each joint; all joints are level at the same angle.

    Simulation: adds ``γ cos(y − φ)`` to each output y.
    Drivers: the outputs only.
    Units: γ in the outputs' unit.
    Plausible: up to 0.5 rad.
    Source: see :class:`GravitySag`.
    """

    port = "outputs"
    needs = (SEVERAL, "angle")
