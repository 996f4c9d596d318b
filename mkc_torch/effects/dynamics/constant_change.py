"""A constant of the simulation with another value."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.unit_text import sized
from mkc_torch.effects.base import GainEffect
from mkc_torch.effects.context import Context, Shape

if TYPE_CHECKING:
    from jaxtyping import Float


class ConstantChange(GainEffect):
    """A number that the simulation takes as known has another value: a payload, a base that is not level, a length.

    Simulation: adds γ to a constant of a :class:`mkc_torch.simulation.Stepper`; of a MuJoCo model, to the mass of a
        body, the tilt of gravity, the zero of a joint, the length of a link or the inertia of a joint's drive.
    Drivers: none.
    Units: γ in the constant's unit.
    Plausible: any size within the constant's bounds, either sign.
    Source: parametric errors of rigid-body models, Siciliano et al., "Robotics" (2009), 7.3.
    """

    id = "constant_change"
    display_name = "another value of a constant"
    port = "constant"
    follows_signal = True
    needs: tuple[str, ...] = ("own",)
    gain = "change"
    equation = "δc = γ"
    explanation = "A constant of the simulation has another value."
    advice = "Measure this constant, or let the simulation fit it."
    source = "parametric errors of rigid-body models, Siciliano et al., Robotics (2009), 7.3"

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        return torch.ones_like(context.time)

    def explained(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        more = "more" if gamma[0] > 0 else "less"
        return f"`{context.channels[0]}` is {sized(abs(gamma[0]), context.signal_unit)} {more} than in the simulation."

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        return (f"{gamma[0]!r}",)
