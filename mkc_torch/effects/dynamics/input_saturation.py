"""An actuator at its limit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.protocol import Context, GainEffect, Quantity, Shape

if TYPE_CHECKING:
    from jaxtyping import Float

LIMITS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
"""As shares of the largest input."""


class InputSaturation(GainEffect):
    """Beyond a limit the actuator gives no more.

    Simulation: adds ``−γ (u − clip(u, ±c))`` to an input; a γ of one is a hard limit.
    Drivers: none but the input.
    Units: γ is a share; the shape ``limit`` in the unit of what it is of.
    Plausible: γ from 0 to 1.
    Source: Khalil, "Nonlinear Systems" (2002), 1.2.7.
    """

    id = "input_saturation"
    relative: Mapping[str, tuple[str, str]] = {"limit": ("own", "largest")}
    port = "input"
    follows_signal = True
    least, most = 0.0, 1.0
    needs: tuple[str, ...] = ("own",)
    plausible = 1.5
    gain = "share"
    along = "own"
    equation = "δu = −γ (u − clip(u, ±c))"
    explanation = "The actuator reaches its limit: beyond it, a larger command has no more effect."
    advice = "Limit the input to this size."
    source = "Khalil, Nonlinear Systems (2002), 1.2.7"

    def shapes(self, time: object) -> Sequence[Shape]:  # noqa: ARG002
        return tuple({"limit": limit} for limit in LIMITS)

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:  # noqa: ARG002
        return (Quantity(self.gain, 1, ""),)

    def course(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        own = context.part("own")
        limit = shape["limit"]
        return own.clamp(-limit, limit) - own

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        own, limit = names["own"], shape["limit"]
        return (f"{gamma[0]!r} * ({own}.clamp({-limit!r}, {limit!r}) - {own})",)
