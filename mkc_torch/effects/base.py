"""What an effect is: physics with an amplitude γ that changes what passes through a port of a simulation."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NoReturn

from torch import Tensor

from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.courses import gained, per
from mkc_torch.effects.kinds import kind_at

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["Effect", "GainEffect", "in_words"]

_WRITTEN = {
    "hard iron": "hard-iron",
    "soft iron": "soft-iron",
    "coulomb": "Coulomb",
    "stribeck": "Stribeck",
    "bouc": "Bouc",
    "wen": "Wen",
    "magnus": "Magnus",
}
"""Names of people, and words that are written as one."""


class Effect(ABC):
    """A piece of physics with an amplitude γ of q numbers. At γ = 0 it changes nothing.

    Derive from it, set ``id`` and what a user reads, and give :meth:`quantities` and :meth:`change`. All else has a
    default, and is for an effect that is, or can do, more. :class:`GainEffect` has these two methods as well, for a
    gain per channel times one course.

    What a user reads:

    Attributes:
        id: its name in ``diagnosis.json`` and ``model.json``; every effect needs one.
        display_name: its name in a sentence; default the id in words, see :func:`in_words`. A report knows the id alone, and
            tells an effect that is not in the catalogue by its id in words.
        words_by_kind: that name by the kind of quantity that it acts on, where the plain one does not suit it; default
            none.
        equation: what it adds, in symbols; :meth:`equation_of` where the shape chooses its form.
        explanation: a sentence on what happens.
        advice: a sentence on what to do about it.
        by_kind: explanation and advice by the kind of quantity that it acts on, such as "temperature", see
            :mod:`mkc_torch.effects.kinds`, where the plain ones do not suit it; default none.
        recurrence: what becomes of it in another recording, a clause such as "a warm-up comes again after a cold start";
            default empty, nothing is said of it.
        source: where the physics and its size are from.
        plausible: largest plausible size of each number of the first quantity of γ; default infinite, nothing is known.
        plausible_unit: the unit of ``plausible``; default empty, the quantity's own.

    Where it is tried:

    Attributes:
        port: name or kind of the ports where it acts; default "sensor".
        needs: parts that such a port must have; default none.
        excludes: parts that such a port must not have, as another form of the effect is for those; default none.
        roles: of the columns that drive it, as :mod:`mkc_torch.diagnosis.model.drivers` gives them; default empty, it
            follows time or the signal alone.
        driver_optional: whether one with roles is tried without a driver too; default False.
        follows_signal: whether its change depends on the signal at its port; default False.
        location_specific: whether it is of the place or the attitude of its recording, which another one does not have; default
            False.
        is_curve: whether it is a curve that follows the data and no physics; default False. Named physics goes first.
        is_generalisation: whether it has named ones as special cases, such as drags or an added mass; these go first where they
            do as well. Default False.
        unrecorded: whether it is a course along time that stands for a cause in no column; default False.
        remembers: whether its change at a moment depends on the signal at other moments; of effects in series on an
            input or an output those act first. Default False.
        settles: parts of the clocks, "offset" or "rate", that it is the same as where it acts on all outputs: beside it
            the simulation's own are held. Default none.

    Of its amplitude and its shape:

    Attributes:
        least, most: bounds of each number of γ; default −∞ and ∞.
        relative: name of a number of its shapes to the part of the signal it is a share of, or "driver", and whether
            of its "typical" or its "largest" size; such numbers are in that part's unit once a recording is known.
        continuous: name of a number that can take any value, and is closed in on after the search of the grid, to its
            least and largest value as shares of the recording's length; such a number is in s.
        fitted_shape: name of a number that is fitted together with γ once the effect is known to be there, to its
            least and greatest value, in the same shares where it is relative or continuous. ``change`` and
            ``quantities`` have to take it as a tensor, and ``change`` to have a slope in it. One that is always
            positive is fitted as its logarithm.
        natural_ends: of numbers that are fitted, which end of the range, "least" or "greatest", is a value like any
            other; at another end a number is to be doubted. Default none.
        form_parameters: names of the numbers that choose a form and are not measured; the equation tells them.
        shape_units: name of a number of the shape to its unit, of those that have one whatever is recorded; default
            times that are called onset, lag, delay or time_constant.
        plot_axis: the part of the signal that it mainly follows, along which its curve is drawn; default none.
        reduces_to: another effect that this one is with fewer numbers, its shape among this one's; default None.
        simpler: the same physics with fewer numbers in γ, each of which stands for several of this one's, one after
            the other; its shapes are the same. It is taken where it predicts unseen blocks as well. Default None.

    Example:
        >>> import torch
        >>> class Square(Effect):
        ...     id = "squared_response"
        ...     follows_signal = True
        ...     equation = "δB = γ B²"
        ...
        ...     def quantities(self, shape, context):
        ...         return (Quantity("coefficient", len(context.channels), f"1/{context.signal_unit}"),)
        ...
        ...     def change(self, gamma, shape, context):
        ...         return gamma * context.signal.square()
        >>> Square().display_name, Square().port, Square().shapes(torch.arange(3.0)), Square().persistent_change
        ('squared response', 'sensor', ({},), False)
    """

    id: str = ""
    equation: str = ""
    explanation: str = ""
    advice: str = ""
    by_kind: Mapping[str, tuple[str, str]] = {}
    words_by_kind: Mapping[str, str] = {}
    recurrence: str = ""
    source: str = ""
    plausible: float = math.inf
    plausible_unit: str = ""

    port: str = "sensor"
    needs: tuple[str, ...] = ()
    excludes: tuple[str, ...] = ()
    reduces_to: Effect | None = None
    roles: tuple[str, ...] = ()
    driver_optional: bool = False
    follows_signal: bool = False
    location_specific: bool = False
    is_curve: bool = False
    is_generalisation: bool = False
    unrecorded: bool = False
    remembers: bool = False
    settles: tuple[str, ...] = ()

    lower: float = -math.inf
    upper: float = math.inf
    relative: Mapping[str, tuple[str, str]] = {}
    continuous: Mapping[str, tuple[float, float]] = {}
    fitted_shape: Mapping[str, tuple[float, float]] = {}
    natural_ends: Mapping[str, tuple[str, ...]] = {}
    form_parameters: tuple[str, ...] = ()
    shape_units: Mapping[str, str] = dict.fromkeys(("onset", "lag", "delay", "time_constant"), "s")
    plot_axis: str = ""

    @abstractmethod
    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        """The parameters that γ holds, in its order; their sizes add up to q."""

    @abstractmethod
    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        """What the effect adds to the c channels of its port."""

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:  # noqa: ARG002
        """The grid of shapes that is searched, for a recording at these times in s; default one without numbers."""
        return ({},)

    @property
    def display_name(self) -> str:
        return in_words(self.id)

    @property
    def simpler(self) -> Effect | None:
        return None

    @property
    def one_sided(self) -> bool:
        """Whether no number of γ can be negative."""
        return self.lower >= 0.0

    def within_a_sample(self, shape: Shape, step: float) -> bool:  # noqa: ARG002
        """Whether this shape says no more than what an input does between two samples, ``step`` s apart."""
        return False

    def reports(self, name: str) -> bool:
        """Whether a number of the shape is told as a parameter; default all that choose no form."""
        return name not in self.form_parameters

    def unit_of_shape(self, name: str, context: Context) -> str:
        """The unit of a number of the shape; empty where it has none.

        Default that of what it is ``relative`` to, else the one in ``shape_units``.
        """
        if name in self.relative:
            part = self.relative[name][0]
            return context.units[0] if part == "driver" else context.unit_of(part)
        return self.shape_units.get(name, "")

    def equation_of(self, shape: Shape, context: Context) -> str:  # noqa: ARG002
        """The equation in the form that the shape chose; default ``equation``."""
        return self.equation

    def explained(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:  # noqa: ARG002
        """The explanation for the kind of quantity that it acts on, with sizes where it tells them."""
        return self.by_kind.get(kind_at(context), (self.explanation, self.advice))[0]

    def advised(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:  # noqa: ARG002
        """The advice for the kind of quantity that it acts on, with sizes where it tells them."""
        return self.by_kind.get(kind_at(context), (self.explanation, self.advice))[1]

    def components(self, quantity: str, shape: Shape, context: Context) -> tuple[str, ...]:  # noqa: ARG002
        """What each number of a quantity is, in their order; default empty, they are one for each channel."""
        return ()

    def moments(self, context: Context) -> tuple[float, ...]:  # noqa: ARG002
        """When it sets in, in s and ascending, where that is several moments known beforehand; default none."""
        return ()

    def bind(self, shape: Shape, context: Context) -> Shape:  # noqa: ARG002
        """The shape with what it needs to know of this recording to act on another one; default as it is."""
        return shape

    def basis(self, shape: Shape, context: Context) -> Float[Tensor, "N c q"]:  # noqa: ARG002
        """Of an effect that is ``basis @ γ``: many of its shapes are tried in no time. Ask ``has_basis`` before."""
        self._refuse("basis")

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:  # noqa: ARG002
        """Of an effect that is ``gain ⊗ waveform``: the waveform at a gain of one. Ask ``has_course`` before."""
        self._refuse("course")

    def lasting(self, gamma: Float[Tensor, " q"], context: Context) -> Float[Tensor, "N c"]:  # noqa: ARG002
        """Of an effect that is bound to the time of its recording: what a later one has of it. Ask ``persistent_change`` before."""
        self._refuse("lasting")

    def code(self, gamma: Sequence[float], shape: Shape, names: Mapping[str, str]) -> tuple[str, ...]:  # noqa: ARG002
        """An expression of Python with torch for each channel: what is added to it. Ask ``has_code`` before.

        Args:
            gamma: the effect's numbers.
            shape: its shape.
            names: expression of each part of the port's signal, such as ``{"own": "x.speed"}``; "memory", "memory_2"
                and so on of internal states; "zero" is what makes a temperature absolute.
        """
        self._refuse("code")

    @property
    def has_basis(self) -> bool:
        """Whether it gives a :meth:`basis`."""
        return type(self).basis is not Effect.basis

    @property
    def has_course(self) -> bool:
        """Whether its change is a gain per channel times its :meth:`waveform`."""
        return type(self).change is GainEffect.change

    @property
    def persistent_change(self) -> bool:
        """Whether it says what is :meth:`lasting`."""
        return type(self).lasting is not Effect.lasting

    @property
    def has_code(self) -> bool:
        """Whether it can be written out as :meth:`code`; ``code = Effect.code`` gives that up in a derived one."""
        return type(self).code is not Effect.code

    def _refuse(self, method: str) -> NoReturn:
        raise NotImplementedError(f"Expected the effect {self.id} to have a method `{method}`; give it one.")


class GainEffect(Effect):
    """An effect that adds a gain per channel times one course: ``gain ⊗ waveform``. Give it a ``waveform``.

    Attributes:
        gain: what a user reads the gain as.

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
        ...     def waveform(self, shape, context):
        ...         return context.drivers[:, 0]
        >>> SupplyOffset().port
        'sensor'
    """

    gain: str = "gain"

    def unit(self, context: Context) -> str:
        """Of the gain: the signal's unit, for each unit of the driver."""
        return per(context.signal_unit, context.units[0]) if context.units else context.signal_unit

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:  # noqa: ARG002
        return (Quantity(self.gain, len(context.channels), self.unit(context)),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        return gained(self.waveform(shape, context), gamma)


def in_words(effect_id: str) -> str:
    """An id in words: blanks for underscores, people's names with a capital.

    Example:
        >>> in_words("soft_iron_step"), in_words("coulomb_friction"), in_words("supply_offset")
        ('soft-iron step', 'Coulomb friction', 'supply offset')
    """
    told = f" {effect_id.replace('_', ' ')} "
    for plain, written in _WRITTEN.items():
        told = told.replace(f" {plain} ", f" {written} ")
    return told[1:-1]
