"""An error of a sensor's zero."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.base import GainEffect
from mkc_torch.effects.context import SEVERAL, Context, Shape

if TYPE_CHECKING:
    from jaxtyping import Float


class Offset(GainEffect):
    """The measured output differs from the simulated output by a constant.

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
    explanation = "The measured output differs from the simulated output by a constant."
    advice = "Check the sensor's zero, and that of the simulator."
    by_kind: Mapping[str, tuple[str, str]] = {
        "angle": (
            "The measured angle differs from the simulated angle by a constant, as from a wrong zero or a load.",
            "Check the joint's zero. Under a load gravity deflects a servo like this: compare with the load's "
            "torque over the joint's stiffness.",
        )
    }
    recurrence = "an offset is also there without a signal"
    source = "Doebelin, Measurement Systems (2003), 3.2"

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        return torch.ones_like(context.time)


class SeveralOffsets(Offset):
    """An offset of all outputs, one for each.

    Simulation: adds γ to each output.
    Drivers: the outputs only.
    Units: γ in the outputs' unit.
    Plausible: any size.
    Source: see :class:`Offset`.
    """

    port = "outputs"
    needs = (SEVERAL,)
