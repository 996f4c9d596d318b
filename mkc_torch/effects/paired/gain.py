"""An error of a sensor's scale."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.base import GainEffect
from mkc_torch.effects.context import Context, Quantity, Shape

if TYPE_CHECKING:
    from jaxtyping import Float


class Gain(GainEffect):
    """The measured output is a constant share larger or smaller than the simulated output.

    Simulation: adds ``γ y`` to an output y.
    Drivers: the output only.
    Units: γ is a share.
    Plausible: |γ| up to 0.5.
    Source: scale errors of sensors; Doebelin, "Measurement Systems" (2003), 3.2.
    """

    id = "gain"
    port = "output"
    needs = ("own", "compared")
    follows_signal = True
    plot_axis = "own"
    gain = "gain_error"
    plausible = 0.5
    equation = "δy = γ y"
    explanation = "The measured output is a constant share larger, or smaller, than the simulated output."
    advice = "Check the sensor's scale and units, and those that the simulator assumes."
    recurrence = "a scale error grows with the signal"
    source = "Doebelin, Measurement Systems (2003), 3.2"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity(self.gain, 1, ""),)

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        return context.part("own")
