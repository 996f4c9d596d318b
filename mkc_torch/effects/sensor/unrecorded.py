"""A course of the offset along one direction whose cause no column recorded."""

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

__all__ = ["COURSE", "Unrecorded"]

COURSE = "course_"
"""What the numbers of the course are called, before their number."""


class Unrecorded(GainEffect):
    """Something that was not recorded, such as a heater or a supply current, moves the offset to and fro.

    Simulation: adds ``Δb s(t)`` to the sensor's axes, with one course s for all of them that spans a range of 1 over
    the recording and ends at 0.
    Drivers: none that was recorded.
    Units: Δb in µT; the course is a sum of cosines, ``Σ c_k cos(π k (n + ½) / N)`` of sample n of N, and has no unit.
    Plausible: any size.
    Source: none; what moves the axes together is one cause, whatever it is.

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
    equation = "δB = Δb s(t),  one course s for all axes"
    explanation = "Something that was not recorded moved the sensor's offset to and fro along one direction."
    advice = "Look at its course over time: find out what was warmed, switched or moved then, and record it."
    source = "none: a course, not physics"

    def equation_of(self, shape: Shape, context: Context) -> str:  # noqa: ARG002
        course = "s(t) = Σ c_k cos(π k (n + ½) / N) less its last value"
        return f"{self.equation},  {course},  sample n of N,  {len(shape)} numbers c_k in model.json"

    def reports(self, name: str) -> bool:
        """The course is drawn, and its numbers are not told one by one."""
        return not name.startswith(COURSE)

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:  # noqa: ARG002
        # its course is read off the noise, and none can be tried before
        return ()

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        time = context.time
        phase = math.pi * (torch.arange(len(time), dtype=time.dtype, device=time.device) + 0.5) / len(time)
        course = torch.zeros_like(time)
        for name, amplitude in shape.items():
            course = course + amplitude * torch.cos(int(name.removeprefix(COURSE)) * phase)
        return course - course[-1]

    def lasting(self, gamma: Float[Tensor, " q"], context: Context) -> Float[Tensor, "N c"]:
        """Nothing: the offset that the sensor is left with, where the course ends, is its own one."""
        return torch.zeros_like(gamma).expand(len(context.time), -1)
