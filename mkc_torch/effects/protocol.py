"""What an effect is: physics with an amplitude γ that changes what passes through a port of a simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from mkc_torch.effects.runs import first_of_runs, passed_on, run_numbers

if TYPE_CHECKING:
    from jaxtyping import Float, Int

__all__ = [
    "AnchoredEffect",
    "BoundedEffect",
    "ChoosyEffect",
    "CodedEffect",
    "ComponentsEffect",
    "Context",
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
    "Quantity",
    "RelativeEffect",
    "Shape",
    "ShapeUnitsEffect",
    "ShapedEffect",
    "SignalEffect",
    "TellingEffect",
]

_LEAST = 1e-12

Shape = Mapping[str, float]
"""Numbers that an effect is not linear in, such as its onset or a time constant in s; they are searched, not fitted."""


@dataclass(frozen=True)
class Context:
    """What an effect sees of a recording: N samples, k drivers, c channels of the port it acts on.

    Attributes:
        time: in s.
        drivers: (N, k), in the recording's units, less their means over the recording that was diagnosed.
        units: of the drivers.
        signal: (N, c), what passes through the port.
        signal_unit: the unit of what is added to it.
        channels: names of the components that are added to; of the signal's too, where ``carries`` is empty.
        carries: names of the signal's components, where they are more than what is added to.
        parts: what components of the signal are to each other, such as ``{"own": "speed", "position": "angle"}``.
        part_units: of the parts.
        run: number of each sample's run, where the simulation knows of runs.

    Example:
        >>> time = torch.tensor([0.0, 1.0, 2.0, 0.0, 1.0])
        >>> context = Context(time, torch.zeros(5, 1), ("A",), torch.zeros(5, 2), "µT", ("x", "y"))
        >>> context.runs  # one begins where time goes back
        tensor([0, 0, 0, 1, 1])
        >>> context.component("y").shape
        torch.Size([5])
    """

    time: Float[Tensor, " N"]
    drivers: Float[Tensor, "N k"]
    units: tuple[str, ...]
    signal: Float[Tensor, "N c"]
    signal_unit: str
    channels: tuple[str, ...]
    carries: tuple[str, ...] = ()
    parts: Mapping[str, str] = field(default_factory=dict)
    part_units: Mapping[str, str] = field(default_factory=dict)
    run: Int[Tensor, " N"] | None = None

    @property
    def runs(self) -> Int[Tensor, " N"]:
        """Number of each sample's run; where the simulation knows of none, one begins where time goes back."""
        # the points of a curve, which are fewer, are of no run
        known = self.run is not None and len(self.run) == len(self.time)
        return self.run if known and self.run is not None else run_numbers(self.time)

    @property
    def memory(self) -> Float[Tensor, " N"] | None:
        """The internal state of a port with memory, where a trajectory is being solved for; None elsewhere."""
        known = len(self.carries or self.channels)
        return self.signal[:, known] if self.signal.shape[1] > known else None

    def part(self, name: str) -> Float[Tensor, " N"]:
        """The component of the signal that is this part.

        Raises:
            KeyError: the port has no such part; :class:`ChoosyEffect` says which an effect needs.
        """
        return self.component(self.parts[name])

    def component(self, name: str) -> Float[Tensor, " N"]:
        """The component of the signal that is called this."""
        return self.signal[:, (self.carries or self.channels).index(name)]

    def unit_of(self, part: str) -> str:
        """The unit of a part; empty where it is not known."""
        return self.part_units.get(part, "")


class Quantity(NamedTuple):
    """A parameter as a user reads it: it covers ``size`` numbers of γ, in ``unit``.

    Example:
        >>> Quantity("offset_change", 3, "µT")  # of three axes
        Quantity(name='offset_change', size=3, unit='µT')
    """

    name: str
    size: int
    unit: str


class Effect(Protocol):
    """A piece of physics. At γ = 0 it changes nothing.

    An effect may have a ``plausible_unit``, the unit that ``plausible`` is in, where it is one of its own and not that
    of the recording. Some effects can do more: :class:`SignalEffect`, :class:`ContinuousEffect`, :class:`LinearEffect`,
    :class:`LastingEffect`, :class:`ShapedEffect`, :class:`AnchoredEffect`.

    Attributes:
        id: its name in ``diagnosis.json``.
        port: where it acts; an effect is tried where a simulation has that port.
        roles: the roles of the columns that drive it, as :mod:`mkc_torch.diagnosis.drivers` gives them; empty for an
            effect of time or of the signal alone.
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


def gained(course: Float[Tensor, " N"], gain: Float[Tensor, " c"]) -> Float[Tensor, "N c"]:
    """A course times a gain for each channel."""
    return course.unsqueeze(-1) @ gain.unsqueeze(0)


def per(unit: str, other: str) -> str:
    """The unit of one for each of the other.

    Example:
        >>> per("µT", "A"), per("µT", ""), per("µT", "°C")
        ('µT/A', 'µT', 'µT/K')
    """
    return f"{unit}/{'K' if other == '°C' else other}" if other else unit


def after(time: Float[Tensor, " N"], onset: float) -> Float[Tensor, " N"]:
    """0 before the onset, 1 from it on."""
    return (time >= onset).to(time.dtype)


def combined(basis: Float[Tensor, "N c q"], gamma: Float[Tensor, " q"]) -> Float[Tensor, "N c"]:
    """``basis @ γ``."""
    # as one matrix: with many γ at once the basis of each sample would be copied for each of them
    return (basis.flatten(0, 1) @ gamma).unflatten(0, basis.shape[:2])


def lagged(
    values: Float[Tensor, " N"], time: Float[Tensor, " N"], lag: float, run: Int[Tensor, " N"] | None = None
) -> Float[Tensor, " N"]:
    """Values behind a first-order lag with this time constant in s, at rest before the first sample of each run.

    ``lag ẏ = x − y``, exact for intervals of any length where x goes straight from sample to sample.

    Args:
        values: x at the samples.
        time: of the samples in s.
        lag: in s; nothing changes where it is not positive.
        run: of each sample's run; None where a run begins when time goes back, and only there.

    Example:
        >>> time = torch.arange(0.0, 5.0, 0.01, dtype=torch.float64)
        >>> float(lagged((time - 1.0).clamp(min=0.0), time, 1.0)[200])  # a ramp: 1 - (1 - 1 / e)
        0.367...
    """
    if lag <= 0:
        return values
    first = first_of_runs(run_numbers(time) if run is None else run)
    ratio = torch.cat([time.new_zeros(1), time.diff()]).clamp(min=0.0) / lag
    keep = torch.where(first, 0.0, torch.exp(-ratio))
    ratio = ratio.clamp(min=_LEAST)
    late = torch.where(first, 0.0, -torch.expm1(-ratio) / ratio)
    away = values - values[0]
    before = torch.cat([away[:1], away[:-1]])
    return values[0] + passed_on(keep, (late - keep) * before + (1.0 - late) * away)
