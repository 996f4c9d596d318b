"""A delay between simulation and recording."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import SEVERAL, Context, Quantity, Shape
from mkc_torch.effects.paired.between import shifted

if TYPE_CHECKING:
    from jaxtyping import Float


class Delay(Effect):
    """The recording is later than the simulation by a constant time, or earlier.

    Simulation: adds ``y(t − γ) − y(t)`` to an output y.
    Drivers: the output only.
    Units: γ in s, negative where the recording is early.
    Plausible: any size; the search cannot find a delay longer than a quarter of the signal's shortest period.
    Source: transport delays; Åström & Murray, "Feedback Systems" (2008), 3.4.
    """

    id = "delay"
    port = "output"
    needs: tuple[str, ...] = ("own", "compared")
    follows_signal = True
    remembers = True
    settles = ("offset",)
    equation = "δy = y(t − γ) − y(t)"
    explanation = "The recording is later than the simulation, or earlier."
    advice = "Look for filters and transport on the way to the recording, and for how its clock was set."
    recurrence = "a delay does not grow with the length of a recording"
    source = "transport delays; Åström & Murray, Feedback Systems (2008), 3.4"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity("delay", 1, "s"),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        pairs = zip(context.signal.unbind(-1), gamma.expand(context.signal.shape[-1]).unbind(), strict=True)
        columns = [shifted(own, context.time, -delay.expand(len(own)), context.runs) - own for own, delay in pairs]
        return torch.stack(columns, -1)


class SeveralDelays(Delay):
    """A delay of all outputs, one for each; reduced to a common delay where that fits as well.

    Simulation: adds ``y(t − γ) − y(t)`` to each output y.
    Drivers: the outputs only.
    Units: γ in s.
    Plausible: any size.
    Source: see :class:`Delay`.
    """

    port = "outputs"
    needs = (SEVERAL,)

    @property
    def simpler(self) -> Effect:
        return CommonDelay()

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity("delay", len(context.channels), "s"),)


class CommonDelay(Delay):
    """A common delay of all outputs."""

    port = "outputs"
    needs = (SEVERAL,)
