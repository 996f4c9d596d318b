"""An actuator at its limit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.share import CORNER, SOFTNESS, Saturation, soft_clip

if TYPE_CHECKING:
    from jaxtyping import Float


class InputSaturation(Saturation):
    """The actuator saturates at a limit; amplifiers and magnets deviate already below it.

    Simulation: adds ``−γ (u − clip(u, ±c))`` to an input u, by :func:`mkc_torch.effects.share.soft_clip`; γ = 1 without
        softness is a hard limit.
    Drivers: the input only.
    Units: γ is a share; the shape ``limit`` in the unit of the input, ``softness`` a share of the limit.
    Plausible: γ from 0 to 1.
    Source: Khalil, "Nonlinear Systems" (2002), 1.2.7.
    """

    id = "input_saturation"
    limits = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
    fitted_shape: Mapping[str, tuple[float, float]] = {"limit": (0.2, 1.5), "softness": SOFTNESS}
    equation = "δu = −γ (u − clip(u, ±c))"
    explanation = "The actuator saturates: beyond its limit a larger command has no more effect."
    advice = "Limit the input to this size."

    def shapes(self, time: object) -> Sequence[Shape]:
        return tuple({"limit": limit, "softness": CORNER} for limit in self.limits)

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        own = context.part("own")
        return soft_clip(own, shape["limit"], shape["softness"]) - own

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        own = names["own"]
        return (f"{gamma[0]!r} * (soft_clip({own}, {shape['limit']!r}, {shape['softness']!r}) - {own})",)
