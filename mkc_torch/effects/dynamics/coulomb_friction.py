"""Dry friction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.unit_text import sized
from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.dynamics.rate import RateEffect

if TYPE_CHECKING:
    from jaxtyping import Float


WIDTHS = (0.3, 0.1, 0.03, 0.01)
"""Widths of the smoothed sign, as shares of the typical speed."""


class CoulombFriction(RateEffect):
    """Dry friction: a force of constant size against the motion at any speed.

    Simulation: adds ``−γ tanh(v / w)`` to the rate of a speed v; the width w, in the speed's unit, smooths the jump at
    standstill, and is reported.
    Drivers: the state only.
    Units: γ in the speed's unit per s; the shape ``width`` in the unit of the speed.
    Plausible: γ ≥ 0.
    Source: Amontons and Coulomb; smoothing as in Andersson, Söderberg & Björklund, Tribology International 40 (2007).
    """

    id = "coulomb_friction"
    relative: Mapping[str, tuple[str, str]] = {"width": ("own", "typical")}
    needs: tuple[str, ...] = ("reversing",)  # at speeds of one sign it is a constant force
    gain = "friction"
    equation = "δv̇ = −γ tanh(v / w)"
    explanation = "Dry friction opposes the motion with a force that does not depend on the speed."
    advice = "Add dry friction of this size."
    form_parameters = ("width",)
    source = "Coulomb's law of friction; Andersson et al., Tribology International 40 (2007), for the smoothing"

    def equation_of(self, shape: Shape, context: Context) -> str:
        width = sized(float(shape["width"]), context.unit_of("own"))
        return f"{self.equation},  w = {width}, chosen, for the jump at standstill is smoothed"

    def shapes(self, time: object) -> Sequence[Shape]:
        return tuple({"width": width} for width in WIDTHS)

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        return -torch.tanh(context.part("own") / shape["width"])

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        return (f"-{gamma[0]!r} * torch.tanh({names['own']} / {shape['width']!r})",)
