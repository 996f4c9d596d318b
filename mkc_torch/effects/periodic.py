"""Periodic disturbances of unknown period: at an output, and at the rate of a state."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.unit_text import sized
from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import Context, Quantity, Shape

if TYPE_CHECKING:
    from jaxtyping import Float

OVERSAMPLING = 4
"""Frequencies per resolution of the recording, 1 / its length; halfway between two, 5 % of the power is lost."""

FEWEST_CYCLES = 4
"""Cycles in the recording below which a sinusoid is not distinguished from a slow disturbance."""

_MOST = 16_384
"""Largest number of frequencies; a longer recording is searched at its lower frequencies only."""

_KNOWN = ((86_400.0, "a day"), (0.02, "the mains at 50 Hz"), (1.0 / 60.0, "the mains at 60 Hz"))
"""Periods in s that have a name."""


class Periodic(Effect):
    """The output has a sinusoidal part of unknown period: a pump, the mains, a day, a second planet.

    Its period is found by a periodogram (:mod:`mkc_torch.diagnosis.search.lines`), not by the grid of candidates, and
    is then fitted together with everything else.

    Simulation: adds ``γ₁ cos(2π (t − t₀) / P) + γ₂ sin(2π (t − t₀) / P)`` to an output.
    Drivers: time only.
    Units: γ in the output's unit; the period P in s, and the start t₀ of the recording in s.
    Plausible: any size.
    Source: Lomb, Astrophysics and Space Science 39 (1976), 447; VanderPlas, "Understanding the Lomb-Scargle
        Periodogram", Astrophysical Journal Supplement 236 (2018), 16, sections 6 and 7.1 for the grid.

    Example:
        >>> time = torch.arange(5.0)
        >>> context = Context(time, torch.zeros(5, 0), (), torch.zeros(5, 1), "V", ("y",))
        >>> shape = {"period": 4.0, "start": 0.0}
        >>> Periodic().change(torch.tensor([0.0, 2.0]), shape, context).squeeze(-1).round(decimals=4) + 0.0
        tensor([ 0.,  2.,  0., -2.,  0.])
    """

    id = "periodic"
    display_name = "periodic disturbance"
    port = "output"
    needs: tuple[str, ...] = ("own", "compared")
    by_periodogram = True
    fitted_shape: Mapping[str, tuple[float, float]] = {"period": (1e-12, 1e12)}  # the periodogram starts at the line
    form_parameters = ("start",)
    shape_units: Mapping[str, str] = {"period": "s", "start": "s"}
    equation = "δy = γ₁ cos(2π (t − t₀) / P) + γ₂ sin(2π (t − t₀) / P),  P the period"
    explanation = "A disturbance repeats with a fixed period through the whole recording."
    advice = (
        "Look for what repeats with this period, such as a pump, a fan, the mains, a rotation or the day, and record "
        "it."
    )
    recurrence = "a disturbance keeps its period, and has another phase"
    source = "Lomb, Astrophysics and Space Science 39 (1976), 447; VanderPlas, ApJS 236 (2018), 16"

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:
        start = float(time.min())
        return tuple({"period": 1.0 / frequency, "start": start} for frequency in frequencies(time).tolist())

    def equation_of(self, shape: Shape, context: Context) -> str:
        return f"{self.equation},  t₀ = {sized(shape['start'], 's')}"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity("amplitude", 2, context.signal_unit),)

    def components(self, quantity: str, shape: Shape, context: Context) -> tuple[str, ...]:
        return ("cos(2π (t − t₀) / P)", "sin(2π (t − t₀) / P)")

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N 1"]:
        phase = 2.0 * math.pi * (context.time - shape["start"]) / shape["period"]
        return (gamma[0] * phase.cos() + gamma[1] * phase.sin()).unsqueeze(-1)

    def code(self, gamma: Sequence[float], shape: Shape, names: Mapping[str, str]) -> tuple[str, ...]:
        phase = f"{2.0 * math.pi / shape['period']!r} * (time - {shape['start']!r})"
        return (f"{gamma[0]!r} * torch.cos({phase}) + {gamma[1]!r} * torch.sin({phase})",)

    def explained(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        period, amplitude = sized(shape["period"], "s"), sized(math.hypot(*gamma), context.signal_unit)
        return (
            f"A disturbance of period {period}, amplitude {amplitude}, acts on {', '.join(context.channels)}; it "
            "repeats through the whole recording."
        )

    def advised(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        resolution = 1.0 / float(context.time.max() - context.time.min())
        known = [name for period, name in _KNOWN if abs(1.0 / period - 1.0 / shape["period"]) < resolution]
        return f"The period is that of {known[0]}. {self.advice}" if known else self.advice


class PeriodicOutput(Periodic):
    """A measured output of differential equations has a sinusoidal part of unknown period: mains hum, vibration.

    Simulation: adds ``γ₁ cos(2π (t − t₀) / P) + γ₂ sin(2π (t − t₀) / P)`` to one output.
    Drivers: time only.
    Units: see :class:`Periodic`.
    Plausible: any size.
    Source: see :class:`Periodic`.
    """

    id = "periodic_output"
    display_name = "periodic disturbance of an output"
    port = "single output"
    needs = ("own",)


class PeriodicRate(Periodic):
    """A force, flow or current of unknown period acts on a state: a pump, an unbalanced rotor, sunshine.

    Simulation: adds ``γ₁ cos(2π (t − t₀) / P) + γ₂ sin(2π (t − t₀) / P)`` to the rate of a state.
    Drivers: time only.
    Units: γ in the state's unit per s; see :class:`Periodic`.
    Plausible: any size.
    Source: see :class:`Periodic`.
    """

    id = "periodic_rate"
    display_name = "periodic disturbance of a rate"
    port = "rate"
    needs = ("own",)
    equation = "δẋ = γ₁ cos(2π (t − t₀) / P) + γ₂ sin(2π (t − t₀) / P),  P the period"


def frequencies(time: Float[Tensor, " N"]) -> Float[Tensor, " F"]:
    """The frequencies in Hz to search, for a recording at these times in s, gaps and runs included.

    From four cycles in the recording to below half of the reciprocal of the median sampling interval, where a sine may
    be 0 at all samples; four in each resolution.

    Example:
        >>> grid = frequencies(torch.arange(101.0))
        >>> len(grid), float(grid[0] * 100), float(grid[-1])
        (184, 4.0, 0.4975)
    """
    known = time.double()
    length = float(known.max() - known.min())
    steps = known.sort().values.diff()
    steps = steps[steps > 0.0]
    if not len(steps):
        return known[:0]
    step = 1.0 / (OVERSAMPLING * length)
    first = FEWEST_CYCLES * OVERSAMPLING
    last = math.ceil(0.5 / float(steps.median()) / step - 1e-6)
    return step * torch.arange(first, max(min(last, first + _MOST), first), dtype=torch.float64)
