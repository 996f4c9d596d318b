"""A sensor whose clock runs fast or slow compared with the clock of the inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.paired.between import shifted
from mkc_torch.effects.runs import since_start

if TYPE_CHECKING:
    from jaxtyping import Float


class SensorClockDrift(Effect):
    """The clock of the sensors runs at another rate than the clock of the inputs; both start together in each run.

    Simulation: adds ``y(t + γ (t − t₀)) − y(t)`` to all outputs y, where t₀ is the start of the run.
    Drivers: the outputs only; tried only on a simulation with inputs, since without inputs any rate constants of the
        simulation scale with its time.
    Units: γ is a share: 10⁻⁶ is one part per million; positive if the recorded times are too small.
    Plausible: |γ| up to 0.02, a wrong divider of a timer or a nominal sample rate.
    Source: Mills, RFC 5905 (2010): at most 5·10⁻⁴ for clocks; up to 0.02 for sample rates of inertial sensors,
        Bosch BMI088 data sheet (2018).
    """

    id = "sensor_clock_drift"
    port = "output"
    needs: tuple[str, ...] = ("driven",)
    follows_signal = True
    remembers = True
    plausible = 0.02
    equation = "δy = y(t + γ (t − t₀)) − y(t)"
    explanation = "The clock of the sensors runs at another rate than the clock of the inputs."
    advice = "Take both times from one clock, or rescale the times of the outputs."
    recurrence = "the error of drifting clocks grows with the length of a recording"
    source = "Mills, RFC 5905 (2010)"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity("rate", 1, ""),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        later = gamma[0] * since_start(context.time, context.runs)
        columns = [shifted(output, context.time, later, context.runs) - output for output in context.signal.unbind(-1)]
        return torch.stack(columns, -1)

    def code(self, gamma: Sequence[float], shape: Shape, names: Mapping[str, str]) -> tuple[str, ...]:
        later = f"{gamma[0]!r} * since_start(time, run)"
        return tuple(f"shifted({own}, time, {later}, run) - {own}" for own in names.values())
