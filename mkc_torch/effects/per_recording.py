"""An effect whose size differs between recordings that are diagnosed together."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import Context, Quantity, Shape
from mkc_torch.effects.waveforms import outer_product

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_NOT_COPIED = ("reduces_to", "mistaken_for", "recordings")
"""Attributes of an effect that its form with a size for each recording does not take over."""

_LARGEST_SHARE = 1.0
"""Upper bound of a γ that is a share, with the effect's size in its shape."""


class PerRecording(Effect):
    """An effect with a common shape and a γ for each of several recordings.

    Each number of γ becomes as many numbers as there are recordings, next to each other.

    Args:
        effect: the effect with a common γ, for which :func:`can_differ` is True.
        recordings: names of the recordings, at least two.
        of_run: (K,), number of the recording of each run; None for a model without its recordings.
        relative: whether γ is 0 in the first recording and a difference from it in the others, because a parameter of
            the simulation acts as the effect with a common γ does.

    Attributes:
        sized: names of the recordings with a γ.
        from_first: whether γ is a difference from the first recording.

    Example:
        >>> from mkc_torch.effects.dynamics.quadratic_drag import QuadraticDrag
        >>> drag = PerRecording(QuadraticDrag(), ("a", "b"), torch.tensor([0, 1]))
        >>> drag.id, drag.form_id, drag.recordings
        ('quadratic_drag', 'quadratic_drag_per_recording', ('a', 'b'))
        >>> speed, run = torch.tensor([[1.0], [2.0], [1.0], [2.0]]), torch.tensor([0, 0, 1, 1])
        >>> parts = {"own": "speed"}
        >>> context = Context(run * 1.0, speed[:, :0], (), speed, "m/s²", ("speed",), parts=parts, run=run)
        >>> drag.change(torch.tensor([0.1, 0.2]), {}, context).flatten().tolist()
        [-0.10000000149011612, -0.4000000059604645, -0.20000000298023224, -0.800000011920929]
    """

    def __init__(
        self,
        effect: Effect,
        recordings: Sequence[str],
        of_run: Int[Tensor, " K"] | None = None,
        *,
        relative: bool = False,
    ) -> None:
        self.effect, self.of_run, self.from_first = effect, of_run, relative
        for name in Effect.__annotations__:
            if name not in _NOT_COPIED:
                setattr(self, name, getattr(effect, name))
        self.recordings = tuple(recordings)
        self.sized = self.recordings[int(relative) :]
        if relative:
            self.lower = -math.inf  # a difference of sizes

    def gamma_of(self, gamma: Float[Tensor, " q"], recording: str) -> Float[Tensor, " p"]:
        """Return γ of the effect in one of the recordings."""
        if recording not in self.sized:
            return torch.zeros_like(gamma[:: len(self.sized)])
        return gamma[self.sized.index(recording) :: len(self.sized)]

    @property
    def first_runs(self) -> list[int]:
        """The first run of each recording."""
        assert self.of_run is not None
        return [int((self.of_run == number).nonzero()[0]) for number in range(len(self.recordings))]

    @property
    def display_name(self) -> str:
        return self.effect.display_name

    @property
    def simpler(self) -> Effect | None:
        """The effect with a common γ; None where a parameter of the simulation acts as that does."""
        return None if self.from_first else self.effect

    @property
    def has_basis(self) -> bool:
        return self.effect.has_basis or self.effect.has_waveform

    @property
    def has_code(self) -> bool:
        return self.effect.has_code

    def shapes(self, time: Float[Tensor, " N"]) -> Sequence[Shape]:
        return self.effect.shapes(time)

    def within_a_sample(self, shape: Shape, step: float) -> bool:
        return self.effect.within_a_sample(shape, step)

    def reports(self, name: str) -> bool:
        return self.effect.reports(name)

    def unit_of_shape(self, name: str, context: Context) -> str:
        return self.effect.unit_of_shape(name, context)

    def bind(self, shape: Shape, context: Context) -> Shape:
        return self.effect.bind(shape, context)

    def equation_of(self, shape: Shape, context: Context) -> str:
        but = f" but {self.recordings[0]}" if self.from_first else ""
        return f"{self.effect.equation_of(shape, context)},  with a γ for each recording{but}"

    def explained(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        return self.effect.explained(self._mean(gamma), shape, context)

    def advised(self, gamma: Sequence[float], shape: Shape, context: Context) -> str:
        plain = self.effect.advised(self._mean(gamma), shape, context)
        return f"{plain} Find what changed between the recordings, and give each its own size."

    def _mean(self, gamma: Sequence[float]) -> list[float]:
        k = len(self.sized)
        return [sum(gamma[first : first + k]) / k for first in range(0, len(gamma), k)]

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        each = self.effect.quantities(shape, context)
        return tuple(quantity._replace(size=quantity.size * len(self.sized)) for quantity in each)

    def components(self, quantity: str, shape: Shape, context: Context) -> tuple[str, ...]:
        known = {each.name: each.size for each in self.effect.quantities(shape, context)}
        labels = self.effect.components(quantity, shape, context)
        if not labels and known[quantity] == len(context.channels) > 1:
            labels = tuple(context.channels)
        if not labels:
            labels = tuple(map(str, range(1, known[quantity] + 1))) if known[quantity] > 1 else ("",)
        return tuple(f"{label} in {name}" if label else name for label in labels for name in self.sized)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N c"]:
        k = len(self.sized)
        total: Tensor | None = None
        for number, there in enumerate(self._members(context)):
            own = torch.cat([gamma[j : j + 1] for j in range(number, len(gamma), k)])
            if self.effect.has_waveform:
                part = outer_product(there * self.effect.waveform(shape, context), own)
            else:
                part = there.unsqueeze(-1) * self.effect.change(own, shape, context)
            total = part if total is None else total + part
        assert total is not None
        return total

    def basis(self, shape: Shape, context: Context) -> Float[Tensor, "N c q"]:
        if self.effect.has_basis:
            plain = self.effect.basis(shape, context)
        else:
            eye = torch.eye(len(context.channels), dtype=context.signal.dtype)
            plain = self.effect.waveform(shape, context)[:, None, None] * eye
        there = torch.stack(self._members(context), -1)
        return (plain.unsqueeze(-1) * there[:, None, None, :]).flatten(-2)

    def _members(self, context: Context) -> list[Float[Tensor, " N"]]:
        """1 at the moments of each recording with a γ, else 0."""
        if self.of_run is None:
            raise ValueError(
                f"Expected the recording to have a known {self.display_name}, which differs between "
                f"{' and '.join(self.recordings)}; select one of them."
            )
        recording = self.of_run[context.runs]
        numbers = range(int(self.from_first), len(self.recordings))
        return [(recording == number).to(context.time.dtype) for number in numbers]

    def code(self, gamma: Sequence[float], shape: Shape, names: Mapping[str, str]) -> tuple[str, ...]:
        k, none = len(self.sized), dict.fromkeys(self.recordings, 0.0)
        each = [none | dict(zip(self.sized, gamma[j : j + k], strict=True)) for j in range(0, len(gamma), k)]
        sizes: Any = [_Selected(known) for known in each]
        return self.effect.code(sizes, shape, names)


class _Selected:
    """A size in generated source that depends on the recording whose sizes are selected; it has no arithmetic."""

    def __init__(self, sizes: Mapping[str, float]) -> None:
        self._sizes = dict(sizes)

    def __repr__(self) -> str:
        return f"selected_size(self, {self._sizes!r})"


def selected_size(system: object, sizes: Mapping[str, float]) -> float:
    """Return the size in the recording that ``sizes_of`` of a corrected simulation names.

    Args:
        system: the simulation of a ``corrected.py``.
        sizes: by recording.

    Raises:
        ValueError: it names none of the recordings.

    Example:
        >>> from types import SimpleNamespace
        >>> selected_size(SimpleNamespace(sizes_of="b"), {"a": 0.1, "b": 0.2})
        0.2
    """
    name = getattr(system, "sizes_of", "")
    if name not in sizes:
        raise ValueError(
            f"the sizes of {type(system).__name__} differ between the diagnosed recordings: set its `sizes_of` to "
            f"{' or '.join(map(repr, sizes))} (`--sizes-of`), not {name!r}."
        )
    return sizes[name]


def is_relative(effect: Effect) -> bool:
    """Whether an effect has a γ relative to that in the first of several recordings."""
    return isinstance(effect, PerRecording) and effect.from_first


def can_differ(effect: Effect) -> bool:
    """Whether an effect is also tried with a size for each recording: named physics whose size is γ.

    Not a curve, a general form, an effect whose γ is a share and whose size is in its shape, such as a delay or a
    saturation, nor one that belongs to a time or a place.

    Example:
        >>> from mkc_torch.effects.dynamics.coulomb_friction import CoulombFriction
        >>> from mkc_torch.effects.dynamics.input_delay import InputDelay
        >>> can_differ(CoulombFriction()), can_differ(InputDelay())
        (True, False)
    """
    bound = effect.location_specific or effect.persistent_change or effect.by_periodogram or effect.open_loop_only
    general = effect.is_curve or effect.is_generalisation or effect.unrecorded or effect.reduces_to is not None
    in_time = effect.remembers or bool(effect.settles) or bool(effect.finite_size)
    return not (bound or general or in_time or effect.upper <= _LARGEST_SHARE)
