"""What effects share whose amplitude is a share: none of it at γ = 0, all of it at γ = 1."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.protocol import Context, GainEffect, Quantity, Shape

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["Saturation", "ShareEffect"]


class ShareEffect(GainEffect):
    """An effect that is there to a share between 0 and 1, on an input or an output. Give it a ``course``."""

    port = "input"
    follows_signal = True
    least, most = 0.0, 1.0
    needs: tuple[str, ...] = ("own",)
    plausible = 1.5
    gain = "share"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:  # noqa: ARG002
        return (Quantity(self.gain, len(context.channels), ""),)


class Saturation(ShareEffect):
    """A signal that goes no further than a limit on either side. Give it its ``limits``, as shares of the largest."""

    relative: Mapping[str, tuple[str, str]] = {"limit": ("own", "largest")}
    along = "own"
    limits: tuple[float, ...]
    source = "Khalil, Nonlinear Systems (2002), 1.2.7"

    def shapes(self, time: object) -> Sequence[Shape]:  # noqa: ARG002
        return tuple({"limit": limit} for limit in self.limits)

    def course(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        own, limit = context.part("own"), shape["limit"]
        return own.clamp(-limit, limit) - own

    def code(self, gamma: Sequence[float], shape: Mapping[str, float], names: Mapping[str, str]) -> tuple[str, ...]:
        own, limit = names["own"], shape["limit"]
        return (f"{gamma[0]!r} * ({own}.clamp({-limit!r}, {limit!r}) - {own})",)
