"""What effects on the rate of change of one state share."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mkc_torch.effects.protocol import Context, GainEffect, Quantity, Shape
from mkc_torch.effects.units import quotient

__all__ = ["RateEffect"]


class RateEffect(GainEffect):
    """An effect that adds ``γ · course`` to the rate of one state. Give it a ``course``, a function of the signal.

    The signal at such a port is all states and inputs; the state whose rate it is, is its part "own", and what that
    state is the speed of, if anything, its part "position".

    Attributes:
        needs: parts that a port must have for the effect to be tried there.
        power: of the state's own unit in the course, for the unit of γ; 0 for a course without unit.
    """

    port = "rate"
    follows_signal = True
    needs: tuple[str, ...] = ("own",)
    least: float = 0.0
    most: float = math.inf
    power: float = 0.0
    of: str = "own"

    @property
    def along(self) -> str:
        return self.of

    def unit(self, context: Context) -> str:
        if not self.power:
            return context.signal_unit
        return quotient(context.signal_unit, context.unit_of(self.of), int(self.power)) or "1/s"

    def shapes(self, time: object) -> Sequence[Shape]:  # noqa: ARG002
        return ({},)

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:  # noqa: ARG002
        return (Quantity(self.gain, 1, self.unit(context)),)
