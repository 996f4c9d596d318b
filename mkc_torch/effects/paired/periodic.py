"""A periodic disturbance of unknown period at an output."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import Context, Quantity, Shape

if TYPE_CHECKING:
    from jaxtyping import Float

_PER_LENGTH = 2.0
"""Frequencies per resolution of the recording, 1 / its length; the middle between two costs a fifth of the gain."""

_MOST = 1200
"""Largest number of frequencies; more would take minutes."""

_LEAST_PERIODS = 1.5
"""Periods within the recording below which a sinusoid cannot be distinguished from a drift."""


class Periodic(Effect):
    """The output has a sinusoidal part of a period that is not known: a pump, mains, a second planet.

    All frequencies of a dense grid are searched, on the recording and on the surrogates of the noise alike, so the
    p-value includes the choice of the frequency. That is the generalised Lomb-Scargle periodogram, a least-squares fit
    at each frequency next to the simulation's own parameters: gaps and uneven times need no care.

    Simulation: adds ``γ₁ cos(2π t / P) + γ₂ sin(2π t / P)`` to an output, t since the start of the recording.
    Drivers: time only.
    Units: γ in the output's unit, the period P in s.
    Plausible: any size.
    Source: Lomb, Astrophysics and Space Science 39 (1976), 447; VanderPlas, "Understanding the Lomb-Scargle
        Periodogram", Astrophysical Journal Supplement 236 (2018), 16, sections 6 and 7.1 for the grid.
    """

    id = "periodic"
    display_name = "periodic disturbance"
    port = "output"
    needs = ("own", "compared")
    narrowband = True
    fitted_shape: Mapping[str, tuple[float, float]] = {"period": (1e-12, 1e12)}  # any: the grid is dense
    shape_units: Mapping[str, str] = {"period": "s"}
    equation = "δy = γ₁ cos(2π t / P) + γ₂ sin(2π t / P),  P the period"
    explanation = "The output has a sinusoidal part of this period that is in no column."
    advice = "Look for a machine, the mains or a motion of this period, and record it."
    recurrence = "a disturbance keeps its period, and has another phase"
    source = "Lomb, Astrophysics and Space Science 39 (1976), 447; VanderPlas, ApJS 236 (2018), 16"

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:
        return tuple({"period": 1.0 / frequency} for frequency in frequencies(time))

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity("amplitude", 2, context.signal_unit),)

    def components(self, quantity: str, shape: Shape, context: Context) -> tuple[str, ...]:
        return ("cos(2π t / P)", "sin(2π t / P)")

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N 1"]:
        phase = 2.0 * math.pi * (context.time - context.time[0]) / shape["period"]
        return (torch.stack([phase.cos(), phase.sin()], -1) @ gamma).unsqueeze(-1)


def frequencies(time: Float[Tensor, " N"]) -> list[float]:
    """The frequencies in Hz to search, for a recording at these times in s: half its resolution apart.

    They end below half of the reciprocal of the median sampling interval, or at the largest number of frequencies.

    Example:
        >>> grid = frequencies(torch.arange(100.0))
        >>> len(grid), round(grid[0] * 99, 3), round(grid[-1], 3)
        (96, 1.5, 0.495)
    """
    length = float(time.max() - time.min())
    steps = time.sort().values.diff()
    steps = steps[steps > 0.0]
    if not len(steps):
        return []
    least, step = _LEAST_PERIODS / length, 1.0 / (_PER_LENGTH * length)
    # at half of the sampling rate itself a sine may be 0 at all samples
    count = math.ceil((0.5 / float(steps.median()) - least) / step - 0.01)
    return [least + k * step for k in range(min(count, _MOST))]
