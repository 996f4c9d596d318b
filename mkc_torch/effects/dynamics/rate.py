"""What effects on the rate of change of one state share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch._support.unit_text import quotient
from mkc_torch.effects.base import GainEffect
from mkc_torch.effects.context import Context, Quantity, Shape

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["SURROUNDINGS", "RateEffect", "beyond"]

SURROUNDINGS = "surroundings"
"""The part that is an input which a state is known by its difference to; in a shape, that the effect is of this."""

_LEAST = 1e-30


class RateEffect(GainEffect):
    """An effect that adds ``γ · waveform`` to the rate of one state. Give it a ``waveform``, a function of the signal.

    The signal at such a port is all states and inputs; the state whose rate it is, is its part "own", and what that
    state is the speed of, if anything, its part "position"; an input that is its surroundings, such as the temperature
    outside, is its part "surroundings".

    Attributes:
        power: of the unit of what it is along in the course, for the unit of γ; 0 for a course without unit.
    """

    port = "rate"
    follows_signal = True
    needs: tuple[str, ...] = ("own",)
    lower = 0.0
    plot_axis = "own"
    power: float = 0.0

    def unit(self, context: Context) -> str:
        if not self.power:
            return context.signal_unit
        return quotient(context.signal_unit, context.unit_of(self.plot_axis), int(self.power)) or "1/s"

    def equation_of(self, shape: Shape, context: Context) -> str:
        beside = f",  u = {context.parts[SURROUNDINGS]}" if SURROUNDINGS in shape else ""
        return f"{self.equation}{beside}"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:  # noqa: ARG002
        return (Quantity(self.gain, 1, self.unit(context)),)


def beyond(values: Float[Tensor, " N"], place: float | Tensor, exponent: float | Tensor) -> Float[Tensor, " N"]:
    """How far values are beyond a place, by a power law: ``h (h / c)ⁿ⁻¹`` with ``h = max(x − c, 0)``.

    Args:
        values: x.
        place: c, in the values' unit; positive.
        exponent: n, at least one.

    Example:
        >>> import torch
        >>> beyond(torch.tensor([1.0, 3.0, 4.0]), 2.0, 1.0), beyond(torch.tensor([1.0, 3.0, 4.0]), 2.0, 2.0)
        (tensor([0., 1., 2.]), tensor([0.0000, 0.5000, 2.0000]))
    """
    height = (values - place).clamp(min=0.0)
    if isinstance(exponent, float) and exponent == 1.0:
        return height  # as it is searched, and far quicker than a power
    # the power's slope in its exponent is a logarithm
    return height * (height / place).clamp(min=_LEAST) ** (exponent - 1.0)
