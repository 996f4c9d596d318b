"""The base class of effects on the rate of a state."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch._support.unit_text import quotient, share_of, sized
from mkc_torch.effects.base import GainEffect
from mkc_torch.effects.context import Context, Quantity, Shape

if TYPE_CHECKING:
    from jaxtyping import Float

SURROUNDINGS = "surroundings"
"""The part that is the input of a state's surroundings; in a shape it marks an effect of the difference from them."""

_MIN_BASE = 1e-30
"""Lower limit of the base of a power whose exponent is differentiated."""


class RateEffect(GainEffect):
    """An effect that adds ``γ · waveform`` to the rate of a state. Implement ``waveform``, a function of the signal.

    The signal at such a port is all states and inputs. Its part "own" is the state whose rate it is; its part
    "position" the position whose speed this state is, if any; its part "surroundings" an input that is the state's
    surroundings, such as the outside temperature.

    Attributes:
        power: power of the unit of ``plot_axis`` in the waveform, for the unit of γ; 0 for a waveform without unit.
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
        input_ = f",  u = {context.parts[SURROUNDINGS]}" if SURROUNDINGS in shape else ""
        return f"{self.equation}{input_}"

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity(self.gain, 1, self.unit(context)),)


_INERTIA = {("N m", "rad/s"): "kg m²", ("N", "m/s"): "kg"}
"""Unit of an inertia, by the units of a force and of its speed."""


def second_mass(context: Context) -> Quantity:
    """A second mass or store: at a rate a share of the first, at an input that is a force its own inertia.

    Example:
        >>> import torch
        >>> joint = Context(
        ...     torch.zeros(1), torch.zeros(1, 0), (), torch.zeros(1, 1), "N m", ("f",), part_units={"own": "rad/s"}
        ... )
        >>> second_mass(joint)
        Quantity(name='inertia', size=1, unit='kg m²')
    """
    own = context.unit_of("own")
    unit = _INERTIA.get((context.signal_unit, own), "")
    return Quantity("inertia" if unit else "share", 1, unit)


def size_of_second(gamma: float, context: Context, of_what: str) -> str:
    """The size of a second mass or store as a phrase."""
    unit = second_mass(context).unit
    return sized(float(f"{gamma:.2g}"), unit) if unit else f"{share_of(gamma)} {of_what}"


def beyond(values: Float[Tensor, " N"], place: float | Tensor, exponent: float | Tensor) -> Float[Tensor, " N"]:
    """A power law beyond a place c: ``h (h / c)ⁿ⁻¹`` with ``h = max(x − c, 0)``.

    Args:
        values: x.
        place: c, in the values' unit; positive.
        exponent: n, at least 1.

    Example:
        >>> import torch
        >>> beyond(torch.tensor([1.0, 3.0, 4.0]), 2.0, 1.0), beyond(torch.tensor([1.0, 3.0, 4.0]), 2.0, 2.0)
        (tensor([0., 1., 2.]), tensor([0.0000, 0.5000, 2.0000]))
    """
    height = (values - place).clamp(min=0.0)
    if isinstance(exponent, float) and exponent == 1.0:
        return height  # the value in the search; much faster than a power
    # the derivative by the exponent is a logarithm of the base
    return height * (height / place).clamp(min=_MIN_BASE) ** (exponent - 1.0)
