"""A sensor at the end of its range."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.protocol import Context, GainEffect, Quantity, Shape

if TYPE_CHECKING:
    from jaxtyping import Float

LIMITS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
"""As shares of the largest output that was measured, and, where that is at the limit, a little below."""


class OutputSaturation(GainEffect):
    """Beyond the end of its range a sensor shows no more.

    Simulation: adds ``−γ (y − clip(y, ±c))`` to an output; a γ of one is a hard limit.
    Drivers: none but the output.
    Units: γ is a share; the shape ``limit`` in the output's unit.
    Plausible: γ from 0 to 1.
    Source: ranges in data sheets; Khalil, "Nonlinear Systems" (2002), 1.2.7.
    """

    id = "output_saturation"
    relative: Mapping[str, tuple[str, str]] = {"limit": ("own", "largest")}
    port = "output"
    needs: tuple[str, ...] = ("own", "compared")
    follows_signal = True
    least, most = 0.0, 1.0
    plausible = 1.5
    gain = "share"
    along = "own"
    equation = "δy = −γ (y − clip(y, ±c))"
    explanation = "The sensor reaches the end of its range: beyond it, it shows no more."
    advice = "Use a sensor of a wider range, or clip what is simulated there."
    source = "Khalil, Nonlinear Systems (2002), 1.2.7"

    def shapes(self, time: object) -> Sequence[Shape]:  # noqa: ARG002
        return tuple({"limit": limit} for limit in LIMITS)

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:  # noqa: ARG002
        return (Quantity(self.gain, 1, ""),)

    def course(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        own, limit = context.part("own"), shape["limit"]
        return own.clamp(-limit, limit) - own
