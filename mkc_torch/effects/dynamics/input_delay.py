"""A delay of an input."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.paired.between import shifted
from mkc_torch.effects.share import ShareEffect

if TYPE_CHECKING:
    from jaxtyping import Float

SHARES = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05)
"""Delays to search, as shares of the longest run."""


class InputDelay(ShareEffect):
    """The system responds to its input with a delay.

    Simulation: adds ``γ (u(t − τ) − u(t))`` to an input u; γ = 1 is a pure delay.
    Drivers: the input only.
    Units: γ is a share; the delay in s.
    Plausible: γ from 0 to 1.
    Source: transport delays; Åström & Murray, "Feedback Systems" (2008), 3.4.
    """

    id = "input_delay"
    remembers = True
    continuous: Mapping[str, tuple[float, float]] = {"delay": (0.0005, 0.1)}
    fitted_shape: Mapping[str, tuple[float, float]] = {"delay": (0.0005, 0.1)}
    equation = "δu = γ (u(t − τ) − u(t))"
    explanation = "The system responds to its input with a delay."
    advice = "Delay the input by this time."
    recurrence = "a delay shifts fast changes of its input and leaves their size"
    source = "transport delays; Åström & Murray, Feedback Systems (2008), 3.4"

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:
        length = float(time.max() - time.min())
        return tuple({"delay": share * length} for share in SHARES)

    def within_a_sample(self, shape: Shape, step: float) -> bool:
        return shape["delay"] <= step

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        own = context.part("own")
        return shifted(own, context.time, -shape["delay"], context.runs) - own

    def code(self, gamma: Sequence[float], shape: Shape, names: Mapping[str, str]) -> tuple[str, ...]:
        own = names["own"]
        return (f"{gamma[0]!r} * (shifted({own}, time, {-shape['delay']!r}, run) - {own})",)
