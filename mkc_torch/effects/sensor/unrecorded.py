"""A variation of the offset along one direction whose cause is not recorded."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.base import GainEffect
from mkc_torch.effects.context import Context, Shape

if TYPE_CHECKING:
    from jaxtyping import Float

COURSE = "course_"
"""Prefix of the names of the waveform's coefficients, before their number."""


class Unrecorded(GainEffect):
    """A cause that was not recorded, such as a heater or a supply current, changes the offset back and forth.

    Simulation: adds ``Δb s(t)`` to the sensor's axes, with one waveform s for all axes that spans a range of 1 over the
    recording and ends at 0.
    Drivers: no recorded column.
    Units: Δb in µT; the waveform is a sum of cosines, ``Σ c_k cos(π k (n + ½) / N)`` of sample n of N, without unit.
    Plausible: any size.
    Source: none; a common variation of the axes has one cause.

    Example:
        >>> from mkc_torch.effects import Context
        >>> time = torch.arange(4.0)
        >>> context = Context(time, torch.zeros(4, 0), (), torch.zeros(4, 1), "µT", ("mag_x",))
        >>> Unrecorded().waveform({"course_1": 0.5}, context)
        tensor([0.9239, 0.6533, 0.2706, 0.0000])
    """

    id = "unknown"
    display_name = "an effect outside the catalogue"
    is_curve = True
    unrecorded = True
    gain = "offset_change"
    equation = "δB = Δb s(t),  one waveform s for all axes"
    explanation = "A cause that was not recorded changed the sensor's offset back and forth along one direction."
    advice = "Look at its variation over time: find out what was warmed, switched or moved then, and record it."
    source = "none: a waveform, not physics"

    def equation_of(self, shape: Shape, context: Context) -> str:
        waveform = "s(t) = Σ c_k cos(π k (n + ½) / N) less its last value"
        return f"{self.equation},  {waveform},  sample n of N,  {len(shape)} numbers c_k in model.json"

    def reports(self, name: str) -> bool:
        """Whether reports list a shape parameter; the waveform is plotted, its coefficients are not listed."""
        return not name.startswith(COURSE)

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:
        # its waveform is estimated from the residual; there is no grid
        return ()

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        time = context.time
        phase = math.pi * (torch.arange(len(time), dtype=time.dtype, device=time.device) + 0.5) / len(time)
        waveform = torch.zeros_like(time)
        for name, amplitude in shape.items():
            waveform = waveform + amplitude * torch.cos(int(name.removeprefix(COURSE)) * phase)
        return waveform - waveform[-1]

    def lasting(self, gamma: Float[Tensor, " q"], context: Context) -> Float[Tensor, "N c"]:
        """Zero: the waveform ends at 0, so the sensor keeps its own offset."""
        return torch.zeros_like(gamma).expand(len(context.time), -1)
