"""A sensor whose zero is off."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.base import GainEffect
from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.paired.alike import SEVERAL

if TYPE_CHECKING:
    from jaxtyping import Float


class Offset(GainEffect):
    """What is measured lies beside what is simulated by a constant.

    Simulation: adds γ to an output.
    Drivers: none.
    Units: γ in the output's unit.
    Plausible: any size.
    Source: zero errors of sensors; Doebelin, "Measurement Systems" (2003), 3.2.
    """

    id = "offset"
    port = "output"
    needs: tuple[str, ...] = ("own", "compared")
    gain = "offset"
    equation = "δy = γ"
    explanation = "What is measured lies beside what is simulated by a constant."
    advice = "Check the sensor's zero, and where the simulator has its own."
    by_kind: Mapping[str, tuple[str, str]] = {
        "angle": (
            "What is measured lies beside what is simulated by a constant, as a wrong zero or a load does.",
            "Check the joint's zero. Where it carries a load, gravity pulls a servo aside like this: compare with the "
            "load's torque over the joint's stiffness.",
        ),
    }
    recurrence = "an offset is there without a signal too"
    source = "Doebelin, Measurement Systems (2003), 3.2"

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:  # noqa: ARG002
        return torch.ones_like(context.time)


class SeveralOffsets(Offset):
    """The same at all outputs, each beside what is simulated by a constant of its own.

    Simulation: adds γ, for each output.
    Drivers: none but the outputs.
    Units: γ in the outputs' unit.
    Plausible: any size.
    Source: that of :class:`Offset`.
    """

    port = "outputs"
    needs = (SEVERAL,)
