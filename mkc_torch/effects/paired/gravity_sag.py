"""A joint that gravity pulls aside."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.paired.alike import SEVERAL

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["GravitySag", "SeveralSag"]

_PER_DEGREE = math.pi / 180.0


class GravitySag(Effect):
    """A joint sags under the weight that it carries, most where the link is level and not where it hangs.

    A servo without integral action holds a load with a steady error: the load's torque over its stiffness. Within a
    small range of angles a sag cannot be told from an offset, which goes first.

    Simulation: adds ``γ cos(y − φ)`` to an output y that is an angle.
    Drivers: none but the output.
    Units: γ in the output's unit; the angle ``phase`` at which the link is level in rad, within a radian of the zero:
        farther off a sag would be no more than an error of scale.
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
    explanation = "Gravity pulls the joint aside, by how far depends on its angle: it sags under its load."
    advice = "Add the load's torque over the joint's stiffness, or feed gravity forward in its controller."
    recurrence = "a sag changes over a wide range of angles and with the load, an offset does not"
    source = "Spong, Hutchinson & Vidyasagar, Robot Modeling and Control (2006), 8.1"

    def shapes(self, time: object) -> Sequence[Shape]:  # noqa: ARG002
        return tuple({"phase": phase} for phase in (0.0, -0.7, 0.7))

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:  # noqa: ARG002
        return (Quantity("sag", len(context.channels), context.signal_unit),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        angle = context.signal * (_PER_DEGREE if context.signal_unit == "°" else 1.0)
        return gamma * torch.cos(angle - shape["phase"])


class SeveralSag(GravitySag):
    """The same at all joints, each with a sag of its own; they are level at the same angle.

    Simulation: adds ``γ cos(y − φ)``, for each output.
    Drivers: none but the outputs.
    Units: γ in the outputs' unit.
    Plausible: up to 0.5 rad.
    Source: that of :class:`GravitySag`.
    """

    port = "outputs"
    needs = (SEVERAL, "angle")
