"""Two clocks of different rate."""

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

    Simulation: adds ``y(t + γ (t − t₀)) − y(t)`` to all outputs, t₀ the middle of the run.
    Drivers: none but the outputs.
    Units: γ is a share: 10⁻⁶ is a part in a million.
    Plausible: |γ| up to 0.01.
    Source: quartz clocks are 10⁻⁴ at worst, clocks of operating systems that are being set 5·10⁻⁴; Mills, RFC 5905.
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
    recurrence = "clocks that drift apart do so the farther, the longer a recording is"
    source = "Mills, RFC 5905 (2010)"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:  # noqa: ARG002
        return (Quantity("rate", 1, ""),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:  # noqa: ARG002
        since = _since_middle(context.time, context.runs)
        later = gamma[0] * since
        columns = [shifted(one, context.time, later, context.runs) - one for one in context.signal.unbind(-1)]
        return torch.stack(columns, -1)


def _since_middle(time: Float[Tensor, " N"], run: Int[Tensor, " N"]) -> Float[Tensor, " N"]:
    count = int(run.max()) + 1
    low = time.new_full((count,), torch.inf).scatter_reduce(0, run, time, "amin")
    high = time.new_full((count,), -torch.inf).scatter_reduce(0, run, time, "amax")
    return time - 0.5 * (low + high)[run]
