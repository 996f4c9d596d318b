"""Candidates' tangents, a few at a time: all of a long recording's at once are more than a computer holds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, overload

import torch
from torch import Tensor

from mkc_torch.diagnosis.model.joint import JointModel, directions, through_port
from mkc_torch.diagnosis.model.term import Term

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["AT_ONCE", "Candidates", "in_blocks", "one_after_the_other", "parts_of"]

AT_ONCE = 8
"""Candidates whose tangents are computed together at most: of a short recording they stay in a core's own memory."""

_CELLS = 4_000_000
"""Numbers of a block of tangents that are worked on at once: 32 MB, of which a Fourier transform makes four times."""

HELD = 8_000_000
"""Numbers of candidates' tangents that are kept, 64 MB; of the others each is made again whenever it is asked for."""


def in_blocks(columns: Sequence[Tensor], at_once: int = AT_ONCE) -> Iterator[list[Tensor]]:
    """So many at a time, or fewer that are :data:`_CELLS` numbers together.

    Example:
        >>> [len(block) for block in in_blocks([torch.ones(1000, 1)] * 10)]
        [8, 2]
        >>> [len(block) for block in in_blocks([torch.ones(1, 1).expand(1_500_000, 1)] * 4)]
        [3, 1]
    """
    block: list[Tensor] = []
    for one in columns:
        block.append(one)
        if len(block) == at_once or sum(known.numel() for known in block) >= _CELLS:
            yield block
            block = []
    if block:
        yield block


class Candidates(Sequence[Tensor]):
    """The tangents with each candidate's γ, (N, m, q); zeros where they are not finite.

    Through a port whose samples are apart a tangent is a product, and made anew each time that it is asked for, but for
    the first ones, of :data:`HELD` numbers. Trajectories are solved for side by side, and kept.

    Args:
        model, parameters: where.
        terms: the candidates.
        pointwise: through each port whose samples are apart, (N, m, channels); of the others None.
    """

    def __init__(
        self,
        model: JointModel,
        parameters: Float[Tensor, " p"],
        terms: Sequence[Term],
        pointwise: Mapping[str, Tensor | None],
    ) -> None:
        self._terms, self._prepared, self._pointwise = tuple(terms), model.prepared, dict(pointwise)
        self._independent = parameters.new_tensor([float(one) for one in self._prepared.independent])
        self._signals: Mapping[str, Tensor] = {}
        self._held: dict[int, Tensor] = {}
        if not self._terms:
            return
        model = model.around(parameters)
        self._signals = model.signals_before(parameters, {term.key for term in self._terms})
        for name, known in self._pointwise.items():
            members = [number for number, term in enumerate(self._terms) if term.port == name]
            if known is None and members:
                self._held |= self._along_trajectories(model, parameters, name, members)
        cells = 0
        for number in range(len(self._terms)):
            if number not in self._held:
                if cells >= HELD:
                    break
                self._held[number] = self[number]
                cells += self._held[number].numel()

    @overload
    def __getitem__(self, number: int) -> Tensor: ...

    @overload
    def __getitem__(self, number: slice) -> Sequence[Tensor]: ...

    def __getitem__(self, number: int | slice) -> Tensor | Sequence[Tensor]:
        numbers = range(len(self._terms))[number]
        return self._one(numbers) if isinstance(numbers, int) else tuple(self._one(one) for one in numbers)

    def __len__(self) -> int:
        return len(self._terms)

    @property
    def parts(self) -> tuple[object, ...]:
        """All that is large of it, itself included."""
        return (self, *self._held.values(), *self._signals.values())

    def _one(self, number: int) -> Tensor:
        if number in self._held:
            return self._held[number]
        term = self._terms[number]
        known, context = self._pointwise[term.port], term.context(self._prepared, self._signals.get(term.port))
        assert known is not None
        if term.effect.has_course and not term.effect.has_basis:
            # a gain on a course: each channel's course is the same
            moved = known * term.effect.waveform(term.shape, context)[:, None, None]
        else:
            moved = torch.einsum("nmc,ncq->nmq", known, directions(term, context))
        return self._usable(term, moved)

    def _along_trajectories(
        self, model: JointModel, parameters: Tensor, port: str, members: Sequence[int]
    ) -> dict[int, Tensor]:
        """Those of candidates at one port, for which the trajectories are solved for together."""
        terms = [self._terms[number] for number in members]
        courses = [directions(term, term.context(self._prepared, self._signals.get(port))) for term in terms]
        moved = through_port(model, parameters, port, torch.cat(courses, -1), None)
        parts = moved.split([one.shape[-1] for one in courses], -1)
        return {number: self._usable(term, part) for number, term, part in zip(members, terms, parts, strict=True)}

    def _usable(self, term: Term, moved: Tensor) -> Tensor:
        if term.effect.follows_signal and not all(self._prepared.independent):
            moved = self._independent[:, None] * moved
        # one that has no slope here is none that could be named
        return moved if bool(moved.isfinite().all()) else torch.zeros_like(moved)


class _Chained(Sequence[Tensor]):
    def __init__(self, sets: Sequence[Sequence[Tensor]]) -> None:
        self._sets = tuple(sets)
        self._places = [(one, number) for one in self._sets for number in range(len(one))]

    @overload
    def __getitem__(self, number: int) -> Tensor: ...

    @overload
    def __getitem__(self, number: slice) -> Sequence[Tensor]: ...

    def __getitem__(self, number: int | slice) -> Tensor | Sequence[Tensor]:
        if isinstance(number, slice):
            return tuple(one[place] for one, place in self._places[number])
        one, place = self._places[number]
        return one[place]

    def __len__(self) -> int:
        return len(self._places)

    @property
    def parts(self) -> tuple[object, ...]:
        return tuple(part for one in self._sets for part in parts_of(one))


def one_after_the_other(*sets: Sequence[Tensor]) -> Sequence[Tensor]:
    """Several sets of candidates as one, whose tangents are still made when they are asked for."""
    return _Chained(sets)


def parts_of(candidates: Sequence[Tensor]) -> tuple[object, ...]:
    """All that is large of a set of candidates, itself included."""
    return candidates.parts if isinstance(candidates, (Candidates, _Chained)) else tuple(candidates)
