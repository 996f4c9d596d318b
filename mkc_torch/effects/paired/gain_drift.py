"""A slow change of an output's scale with time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.base import GainEffect
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.waveforms import outer_product

if TYPE_CHECKING:
    from jaxtyping import Float


class GainDrift(GainEffect):
    """The output's scale changes steadily over the recording: ageing, soiling, warm-up.

    Simulation: adds ``γ y (t − t₀) / T`` to an output y, from the first moment t₀ of the recording to its end after T.
    Drivers: none, it is bound to a time; a later recording has γ y throughout.
    Units: γ is a share, the change of the gain over the recording.
    Plausible: |γ| up to 0.5.
    Source: drift of sensitivity; Doebelin, "Measurement Systems" (2003), 3.2.
    """

    id = "gain_drift"
    port = "output"
    needs = ("own", "compared")
    follows_signal = True
    gain = "gain_change"
    plausible = 0.5
    equation = "δy = γ y (t − t₀) / T"
    explanation = "The output's scale changed steadily over the recording."
    advice = (
        "Look for ageing, soiling or warming up, calibrate the gain again, and record a temperature if it may be the "
        "cause."
    )
    recurrence = "a warm-up comes again after a cold start, ageing goes on"
    source = "Doebelin, Measurement Systems (2003), 3.2"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity(self.gain, 1, ""),)

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        first, last = context.time.min(), context.time.max()
        return context.part("own") * (context.time - first) / (last - first)

    def lasting(self, gamma: Float[Tensor, " q"], context: Context) -> Float[Tensor, "N c"]:
        """The change that remains in a later recording: the gain at the end."""
        return outer_product(context.part("own"), gamma)
