"""A recording that is late, or early."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.paired.alike import SEVERAL
from mkc_torch.effects.paired.between import shifted

if TYPE_CHECKING:
    from jaxtyping import Float


class Delay(Effect):
    """What is measured comes after what is simulated by a constant time, or before it.

    Simulation: adds ``y(t − γ) − y(t)`` to an output y.
    Drivers: none but the output.
    Units: γ in s, negative where the recording is early.
    Plausible: any size; one that is longer than a quarter of the signal's shortest period is not found from nothing.
    Source: transport delays; Åström & Murray, "Feedback Systems" (2008), 3.4.
    """

    id = "delay"
    port = "output"
    needs: tuple[str, ...] = ("own", "compared")
    follows_signal = True
    remembers = True
    settles = ("offset",)
    equation = "δy = y(t − γ) − y(t)"
    explanation = "What is measured comes later than what is simulated, or earlier."
    advice = "Look for filters and transport on the way to the recording, and for how its clock was set."
    recurrence = "a delay is as long in a longer recording"
    source = "transport delays; Åström & Murray, Feedback Systems (2008), 3.4"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:  # noqa: ARG002
        return (Quantity("delay", 1, "s"),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:  # noqa: ARG002
        pairs = zip(context.signal.unbind(-1), gamma.expand(context.signal.shape[-1]).unbind(), strict=True)
        columns = [shifted(own, context.time, -one.expand(len(own)), context.runs) - own for own, one in pairs]
        return torch.stack(columns, -1)


class SeveralDelays(Delay):
    """The same at all outputs, each late by a time of its own; one for all if that does as well.

    Simulation: adds ``y(t − γ) − y(t)``, for each output.
    Drivers: none but the outputs.
    Units: γ in s.
    Plausible: any size.
    Source: that of :class:`Delay`.
    """

    port = "outputs"
    needs = (SEVERAL,)

    @property
    def simpler(self) -> Effect:
        return CommonDelay()

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:  # noqa: ARG002
        return (Quantity("delay", len(context.channels), "s"),)


class CommonDelay(Delay):
    """All outputs late by the same time."""

    port = "outputs"
    needs = (SEVERAL,)
