"""The base classes of effects: physics with an amplitude γ that changes the signal at a port of a simulation."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NoReturn

from torch import Tensor

from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.kinds import Kind, kind_at
from mkc_torch.effects.waveforms import outer_product, per

if TYPE_CHECKING:
    from jaxtyping import Float

_SPELLINGS = {
    "hard iron": "hard-iron",
    "soft iron": "soft-iron",
    "coulomb": "Coulomb",
    "stribeck": "Stribeck",
    "bouc": "Bouc",
    "wen": "Wen",
    "magnus": "Magnus",
}
"""Spellings that differ from the plain words of an id: names of people and hyphenated words."""


PER_RECORDING = "_per_recording"
"""End of the name of an effect with a γ for each recording."""


class Effect(ABC):
    """A piece of physics with an amplitude γ of q numbers. At γ = 0 it changes nothing.

    Derive from it, set ``id`` and the texts for the user, and implement :meth:`quantities` and :meth:`change`. All else
    has a default. :class:`GainEffect` implements these two methods for a gain per channel times one waveform.

    Texts for the user:

    Attributes:
        id: name in ``diagnosis.json`` and ``model.json``; required.
        display_name: name in a sentence; default the id in words, see :func:`in_words`. A report knows only the id, so
            an effect outside the catalogue appears there under its id in words.
        display_name_by_kind: kind of the quantity it acts on to a name that suits this kind better; default none.
        equation: what it adds, in symbols; override :meth:`equation_of` where the shape chooses its form.
        explanation: a sentence on what happens.
        advice: a sentence on what to do about it.
        by_kind: kind of the quantity it acts on, such as "temperature", see :mod:`mkc_torch.effects.kinds`, to an
            explanation and an advice that suit this kind better; default none.
        recurrence: when it recurs in another recording, a clause such as "a warm-up comes again after a cold start";
            default empty, not stated.
        source: reference for the physics and its size.
        plausible: largest plausible size of each number of the first quantity of γ; default infinite, not known.
        plausible_unit: unit of ``plausible``; default empty, the quantity's unit.

    Where it is tried:

    Attributes:
        port: name or kind of the ports where it acts; default "sensor".
        needs: parts that such a port must have; default none.
        excludes: parts that such a port must not have, because another form of the effect covers them; default none.
        roles: roles of the columns that drive it, as :mod:`mkc_torch.diagnosis.model.term` assigns them; default
            empty: it depends on time or the signal only.
        driver_kinds: kinds of quantity of these columns, by unit or name, see :mod:`mkc_torch.effects.kinds`; default
            empty: any kind.
        positive_driver: whether these columns must nowhere be negative, as a flow; default False.
        driven_by_inputs: whether other inputs of the simulation drive it as columns do; default False.
        driver_optional: whether an effect with roles is also tried without a driver; default False.
        follows_signal: whether its change depends on the signal at its port; default False.
        location_specific: whether it belongs to the place or the attitude of its recording and does not transfer to
            another recording; default False.
        is_curve: whether it is a curve fitted to the data rather than physics; default False. Named physics is
            preferred to it.
        is_generalisation: whether named effects, such as drags or an added mass, are special cases of it; they are
            preferred where they fit as well. Default False.
        unrecorded: whether it is a waveform in time whose cause is in no column; default False.
        by_periodogram: whether its shape is found by a periodogram of the residual, and not by the grid of candidates;
            default False.
        remembers: whether its change at a moment depends on the signal at other moments; such effects act first where
            several are in series on an input or an output. Default False.
        settles: parameters of the clocks, "offset" or "rate", that it is equivalent to where it acts on all outputs;
            they are held at 0 while it is fitted. Default none.
        mistaken_for: an effect outside the catalogue that a recording has to exclude before this one is named; default
            None.
        open_loop_only: whether it is computed and fitted along the open loop only, because along a trajectory that an
            observer corrects it would read the recording ahead; default False.
        recordings: names of recordings that are diagnosed together and each have a γ of their own; default none: a
            common γ.

    Amplitude and shape:

    Attributes:
        lower, upper: bounds of each number of γ; default −∞ and ∞.
        relative: name of a shape parameter to the part of the signal, or "driver", that it is a share of, and whether
            of its "typical" or its "largest" size; once a recording is known the parameter is in that part's unit.
        continuous: name of a shape parameter that can take any value and is refined after the grid search, to its
            smallest and largest value as shares of the recording's length; the parameter is in s.
        fitted_shape: name of a shape parameter that is fitted jointly with γ once the effect is found, to its smallest
            and largest value, as shares where it is relative or continuous. ``change`` and ``quantities`` must accept
            it as a tensor, and ``change`` must be differentiable in it. An always positive one is fitted as its
            logarithm.
        natural_ends: name of a fitted shape parameter to the ends of its range, "least" or "greatest", that are
            ordinary values; an estimate at any other end is doubtful. Default none.
        finite_size: name of the shape parameter with the size γ at which its change is computed for the screening, of
            an effect that is far from linear in γ; default none: the derivative at γ = 0.
        form_parameters: names of shape parameters that choose a form and are not measured; the equation states them.
        shape_units: name of a shape parameter to its unit, for those whose unit does not depend on the recording;
            default s for onset, lag, delay and time_constant.
        plot_axis: part of the signal over which its curve is drawn; default none.
        reduces_to: a special case of this effect, or its form to first order, with no more numbers, whose shape is a
            part of this effect's shape; default None.
        simpler: the same physics with fewer numbers in γ, each shared by several consecutive numbers of this effect's
            γ, and with the same shapes. It is preferred where it predicts unseen blocks as well. Default None.

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
    display_name_by_kind: Mapping[str, str] = {}
    recurrence: str = ""
    source: str = ""
    plausible: float = math.inf
    plausible_unit: str = ""

    port: str = "sensor"
    needs: tuple[str, ...] = ()
    excludes: tuple[str, ...] = ()
    reduces_to: Effect | None = None
    roles: tuple[str, ...] = ()
    driver_kinds: tuple[Kind, ...] = ()
    positive_driver: bool = False
    driven_by_inputs: bool = False
    driver_optional: bool = False
    follows_signal: bool = False
    location_specific: bool = False
    is_curve: bool = False
    is_generalisation: bool = False
    unrecorded: bool = False
    by_periodogram: bool = False
    remembers: bool = False
    settles: tuple[str, ...] = ()
    mistaken_for: Effect | None = None
    open_loop_only: bool = False
    recordings: tuple[str, ...] = ()

    lower: float = -math.inf
    upper: float = math.inf
    relative: Mapping[str, tuple[str, str]] = {}
    continuous: Mapping[str, tuple[float, float]] = {}
    fitted_shape: Mapping[str, tuple[float, float]] = {}
    natural_ends: Mapping[str, tuple[str, ...]] = {}
    finite_size: str = ""
    form_parameters: tuple[str, ...] = ()
    shape_units: Mapping[str, str] = dict.fromkeys(("onset", "lag", "delay", "time_constant"), "s")
    plot_axis: str = ""

    @abstractmethod
    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        """The parameters in γ, in its order; their sizes add up to q."""

    @abstractmethod
    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        """The change, (N, c), that the effect adds to the c channels of its port."""

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:
        """The grid of shapes to search, for a recording at these times in s; default one empty shape."""
        return ({},)

    @property
    def display_name(self) -> str:
        return in_words(self.id)

    @property
    def form_id(self) -> str:
        """The id, which for an effect with a γ for each recording ends in ``_per_recording``."""
        return f"{self.id}{PER_RECORDING}" if self.recordings else self.id

    @property
    def simpler(self) -> Effect | None:
        return None

    @property
    def one_sided(self) -> bool:
        """Whether no number of γ can be negative."""
        return self.lower >= 0.0

    def within_a_sample(self, shape: Shape, step: float) -> bool:
        """Whether this shape only changes an input between two samples, ``step`` s apart."""
        return False

    def reports(self, name: str) -> bool:
        """Whether reports list a shape parameter; default all but the ``form_parameters``."""
        return name not in self.form_parameters

    def unit_of_shape(self, name: str, context: Context) -> str:
        """The unit of a shape parameter; empty where it has none.

        Default the unit of what it is ``relative`` to, else its unit in ``shape_units``.
        """
        if name in self.relative:
            part = self.relative[name][0]
            return context.units[0] if part == "driver" else context.unit_of(part)
        return self.shape_units.get(name, "")

    def equation_of(self, shape: Shape, context: Context) -> str:
        """The equation in the form that the shape chooses; default ``equation``."""
        return self.equation

    def explained(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        """The explanation for the kind of quantity it acts on, with sizes where the effect states them."""
        return self.by_kind.get(kind_at(context), (self.explanation, self.advice))[0]

    def advised(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        """The advice for the kind of quantity it acts on, with sizes where the effect states them."""
        return self.by_kind.get(kind_at(context), (self.explanation, self.advice))[1]

    def components(self, quantity: str, shape: Shape, context: Context) -> tuple[str, ...]:
        """Labels of the numbers of a quantity, in order; default empty: one number for each channel."""
        return ()

    def moments(self, context: Context) -> tuple[float, ...]:
        """Its onsets in s, ascending, where they are known before the fit; default none."""
        return ()

    def bind(self, shape: Shape, context: Context) -> Shape:
        """The shape with all that the effect needs from this recording to act on another; default unchanged."""
        return shape

    def basis(self, shape: Shape, context: Context) -> Float[Tensor, "N c q"]:
        """The basis of an effect that is ``basis @ γ``, whose shapes are fast to search. Check ``has_basis`` first."""
        self._refuse("basis")

    def waveform(self, shape: Shape, context: Context) -> Float[Tensor, " N"]:
        """The waveform at a gain of 1 of an effect ``gain ⊗ waveform``. Check ``has_waveform`` first."""
        self._refuse("waveform")

    def lasting(self, gamma: Float[Tensor, " q"], context: Context) -> Float[Tensor, "N c"]:
        """What an effect bound to a time adds to a later recording. Check ``persistent_change`` first."""
        self._refuse("lasting")

    def code(self, gamma: Sequence[float], shape: Shape, names: Mapping[str, str]) -> tuple[str, ...]:
        """For each channel a Python expression with torch of the change. Check ``has_code`` first.

        Args:
            gamma: the effect's amplitudes.
            shape: its shape.
            names: part of the port's signal to its expression, such as ``{"own": "x.speed"}``; internal states are
                "memory", "memory_2" and so on; "zero" is the offset that makes a temperature absolute.
        """
        self._refuse("code")

    @property
    def has_basis(self) -> bool:
        """Whether it implements :meth:`basis`."""
        return type(self).basis is not Effect.basis

    @property
    def has_waveform(self) -> bool:
        """Whether its change is a gain per channel times its :meth:`waveform`."""
        return type(self).change is GainEffect.change

    @property
    def persistent_change(self) -> bool:
        """Whether it implements :meth:`lasting`."""
        return type(self).lasting is not Effect.lasting

    @property
    def has_code(self) -> bool:
        """Whether it implements :meth:`code`; a derived class opts out by ``code = Effect.code``."""
        return type(self).code is not Effect.code

    def _refuse(self, method: str) -> NoReturn:
        raise NotImplementedError(f"Expected the effect {self.id} to have a method `{method}`; give it one.")


class GainEffect(Effect):
    """An effect that adds a gain per channel times one waveform, ``gain ⊗ waveform``. Implement :meth:`waveform`.

    Attributes:
        gain: name of the gain in reports.

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
        """The unit of the gain: the signal's unit per unit of the driver."""
        return per(context.signal_unit, context.units[0]) if context.units else context.signal_unit

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity(self.gain, len(context.channels), self.unit(context)),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        return outer_product(self.waveform(shape, context), gamma)


def in_words(effect_id: str) -> str:
    """An id in words: blanks for underscores, names of people capitalised.

    Example:
        >>> in_words("soft_iron_step"), in_words("coulomb_friction"), in_words("supply_offset")
        ('soft-iron step', 'Coulomb friction', 'supply offset')
    """
    words = f" {effect_id.replace('_', ' ')} "
    for plain, written in _SPELLINGS.items():
        words = words.replace(f" {plain} ", f" {written} ")
    return words[1:-1]
