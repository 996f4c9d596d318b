"""Clocks with different rates."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.paired.between import shifted

if TYPE_CHECKING:
    from jaxtyping import Float, Int


class ClockDrift(Effect):
    """The recording's clock and the simulator's run at different rates.

    Simulation: adds ``y(t + γ (t − t₀)) − y(t)`` to all outputs y, where t₀ is the middle of the run.
    Drivers: the outputs only.
    Units: γ is a share: 10⁻⁶ is one part per million.
    Plausible: |γ| up to 0.01.
    Source: at most 10⁻⁴ for quartz clocks, 5·10⁻⁴ for system clocks under adjustment; Mills, RFC 5905.
    """

    id = "clock_drift"
    port = "outputs"
    follows_signal = True
    remembers = True
    settles = ("rate",)
    plausible = 0.01
    equation = "δy = y(t + γ (t − t₀)) − y(t)"
    explanation = "The recording's clock and the simulator's run at different rates."
    advice = "Take both times from one clock, or rescale one of them."
    recurrence = "the error of drifting clocks grows with the length of a recording"
    source = "Mills, RFC 5905 (2010)"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity("rate", 1, ""),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        since = _since_middle(context.time, context.runs)
        later = gamma[0] * since
        columns = [shifted(output, context.time, later, context.runs) - output for output in context.signal.unbind(-1)]
        return torch.stack(columns, -1)


def _since_middle(time: Float[Tensor, " N"], run: Int[Tensor, " N"]) -> Float[Tensor, " N"]:
    count = int(run.max()) + 1
    low = time.new_full((count,), torch.inf).scatter_reduce(0, run, time, "amin")
    high = time.new_full((count,), -torch.inf).scatter_reduce(0, run, time, "amax")
    return time - 0.5 * (low + high)[run]
