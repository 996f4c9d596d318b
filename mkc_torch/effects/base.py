"""What an effect is: physics with an amplitude γ that changes what passes through a port of a simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from torch import Tensor

from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.courses import gained, per

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = [
    "AnchoredEffect",
    "BoundedEffect",
    "ChoosyEffect",
    "CodedEffect",
    "ComponentsEffect",
    "ContinuousEffect",
    "Effect",
    "FormedEffect",
    "GainEffect",
    "LastingEffect",
    "LinearEffect",
    "MomentsEffect",
    "NestedEffect",
    "OptionalDriverEffect",
    "PartEffect",
    "PlacedEffect",
    "RelativeEffect",
    "ShapeUnitsEffect",
    "ShapedEffect",
    "SignalEffect",
    "TellingEffect",
]


class Effect(Protocol):
    """A piece of physics. At γ = 0 it changes nothing.

    An effect may have a ``plausible_unit``, the unit that ``plausible`` is in, where it is one of its own and not that
    of the recording. Some effects can do more: :class:`SignalEffect`, :class:`ContinuousEffect`, :class:`LinearEffect`,
    :class:`LastingEffect`, :class:`ShapedEffect`, :class:`AnchoredEffect`.

    Attributes:
        id: its name in ``diagnosis.json``.
        port: where it acts; an effect is tried where a simulation has that port.
        roles: the roles of the columns that drive it, as :mod:`mkc_torch.diagnosis.model.drivers` gives them; empty
            for an effect of time or of the signal alone.
        equation: in symbols.
        explanation: a sentence a user reads.
        advice: what to do about it.
        plausible: largest plausible size of each number of the first quantity of γ, in its unit; infinite where
            nothing is known.
        source: where the physics and its size are from.
    """

    @property
    def id(self) -> str: ...
    @property
    def port(self) -> str: ...
    @property
    def roles(self) -> tuple[str, ...]: ...
    @property
    def equation(self) -> str: ...
    @property
    def explanation(self) -> str: ...
    @property
    def advice(self) -> str: ...
    @property
    def plausible(self) -> float: ...
    @property
    def source(self) -> str: ...

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        """The parameters that γ holds, in its order."""
        ...

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:
        """The grid of shapes that is searched."""
        ...

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        """What the effect adds to the signal."""
        ...


@runtime_checkable
class SignalEffect(Effect, Protocol):
    """An effect that can depend on the signal at its port; one without this attribute does not.

    Attributes:
        follows_signal: whether it does.
    """

    @property
    def follows_signal(self) -> bool: ...


@runtime_checkable
class BoundedEffect(Effect, Protocol):
    """An effect whose γ is bounded, as that of a drag, which cannot be negative; one without these attributes is free.

    Attributes:
        least, most: of each number of γ.
    """

    @property
    def least(self) -> float: ...
    @property
    def most(self) -> float: ...


@runtime_checkable
class ChoosyEffect(Effect, Protocol):
    """An effect that is not tried at every port of its kind.

    Attributes:
        needs: parts that the port must have.
    """

    @property
    def needs(self) -> tuple[str, ...]: ...


@runtime_checkable
class OptionalDriverEffect(Effect, Protocol):
    """An effect with roles that is tried without a driver too.

    Attributes:
        driver_optional: whether it is.
    """

    @property
    def driver_optional(self) -> bool: ...


@runtime_checkable
class RelativeEffect(Effect, Protocol):
    """An effect whose grid of shapes is in shares of how large a part of the signal is, or what drives it.

    Attributes:
        relative: name of a number in its shapes to the part, or "driver", and "typical" or "largest".
    """

    @property
    def relative(self) -> Mapping[str, tuple[str, str]]: ...


@runtime_checkable
class PartEffect(Effect, Protocol):
    """An effect that mainly follows one part of the signal, along which its curve is drawn.

    Attributes:
        along: the part.
    """

    @property
    def along(self) -> str: ...


@runtime_checkable
class ContinuousEffect(Effect, Protocol):
    """An effect with numbers in its shape that can take any value, and are closed in on after the search of the grid.

    Attributes:
        continuous: their names, each with its least and largest value as shares of the recording's length in s.
    """

    @property
    def continuous(self) -> Mapping[str, tuple[float, float]]: ...


@runtime_checkable
class ShapedEffect(Effect, Protocol):
    """An effect with numbers in its shape that are fitted together with γ once it is known to be there.

    Its ``change`` and ``quantities`` have to take such a number as a tensor, and ``change`` to have a slope in it.

    Attributes:
        fitted_shape: their names, each with its least and greatest value, in the same shares as ``relative`` and
            ``continuous`` where it is one of those. A number that is always positive is fitted as its logarithm.
    """

    @property
    def fitted_shape(self) -> Mapping[str, tuple[float, float]]: ...


@runtime_checkable
class NestedEffect(Effect, Protocol):
    """An effect of which a simpler one is a special case.

    Attributes:
        simpler: the same physics with fewer numbers in γ, of which each stands for several of this one's, one after the
            other; its shapes are the same. It is taken where it predicts unseen blocks as well.
    """

    @property
    def simpler(self) -> Effect: ...


@runtime_checkable
class LinearEffect(Effect, Protocol):
    """An effect that is ``basis @ γ`` and gives its basis: many shapes of it are tried in no time."""

    def basis(self, shape: Shape, context: Context) -> Float[Tensor, "N c q"]: ...


@runtime_checkable
class LastingEffect(Effect, Protocol):
    """An effect that is bound to the time of its recording, of which something lasts."""

    def lasting(self, gamma: Float[Tensor, " q"], context: Context) -> Float[Tensor, "N c"]:
        """What is left of it in a later recording of the same sensor."""
        ...


@runtime_checkable
class AnchoredEffect(Effect, Protocol):
    """An effect whose shape has to be told something of the diagnosed recording before it can act on another one."""

    def anchored(self, shape: Shape, context: Context) -> Shape:
        """The shape with what it needs of this recording."""
        ...


@runtime_checkable
class CodedEffect(Effect, Protocol):
    """An effect that can be written out as a line of Python with torch, for a simulation that a person keeps."""

    def code(self, gamma: Sequence[float], shape: Shape, names: Mapping[str, str]) -> tuple[str, ...]:
        """An expression for each channel of the port: what is added to it.

        Args:
            gamma: the effect's numbers.
            shape: its shape.
            names: expression of each part of the port's signal, such as ``{"own": "x.speed"}``; "zero" is what makes a
                temperature "own" absolute.
        """
        ...


@runtime_checkable
class FormedEffect(Effect, Protocol):
    """An effect whose shape says which of several forms its equation has.

    Attributes:
        choices: the numbers of its shape that are chosen and not measured; the equation tells them, and no parameter.
    """

    @property
    def choices(self) -> tuple[str, ...]: ...

    def equation_of(self, shape: Shape, context: Context) -> str:
        """The equation in this form."""
        ...


@runtime_checkable
class ShapeUnitsEffect(Effect, Protocol):
    """An effect with numbers in its shape whose units are its own."""

    def unit_of_shape(self, name: str, context: Context) -> str:
        """The unit of a number of its shape; empty where it is no such one."""
        ...


@runtime_checkable
class ComponentsEffect(Effect, Protocol):
    """An effect with quantities of several numbers that are not one for each channel."""

    def components(self, quantity: str, shape: Shape, context: Context) -> tuple[str, ...]:
        """What each number of a quantity is, in their order; empty where they are one for each channel."""
        ...


@runtime_checkable
class MomentsEffect(Effect, Protocol):
    """An effect that sets in at several moments, which are known beforehand."""

    def moments(self, context: Context) -> tuple[float, ...]:
        """In s, ascending."""
        ...


@runtime_checkable
class PlacedEffect(Effect, Protocol):
    """An effect of the place or the attitude of its recording, which another recording does not have.

    Attributes:
        placed: whether it is one.
    """

    @property
    def placed(self) -> bool: ...


@runtime_checkable
class TellingEffect(Effect, Protocol):
    """An effect that says how another recording tells it from a rival.

    Attributes:
        again: what becomes of it in another recording, a clause such as "a warm-up comes again after a cold start".
    """

    @property
    def again(self) -> str: ...


class GainEffect:
    """An effect that adds a gain per channel times one course: ``gain ⊗ course``. Give it a ``course``.

    Example:
        A user's own effect, a bus voltage that shifts the offset:

        >>> class SupplyOffset(GainEffect):
        ...     id = "supply_offset"
        ...     roles = ("voltage",)
        ...     equation = "δB = k (V − V₀)"
        ...     explanation = "The offset follows the supply voltage."
        ...     plausible = 1.0
        ...     source = "our bench, 2024"
        ...
        ...     def course(self, shape, context):
        ...         return context.drivers[:, 0]
        >>> SupplyOffset().port
        'sensor'
    """

    id: str
    port: str = "sensor"
    roles: tuple[str, ...] = ()
    equation: str = ""
    explanation: str = ""
    advice: str = ""
    plausible: float = float("inf")
    plausible_unit: str = ""
    source: str = ""
    gain: str = "gain"

    def course(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        """How the effect goes along the recording, at a gain of one."""
        raise NotImplementedError

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:  # noqa: ARG002
        return ({},)

    def unit(self, context: Context) -> str:
        """Of the gain: the signal's unit, for each unit of the driver."""
        return per(context.signal_unit, context.units[0]) if context.units else context.signal_unit

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:  # noqa: ARG002
        return (Quantity(self.gain, len(context.channels), self.unit(context)),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        return gained(self.course(shape, context), gamma)
