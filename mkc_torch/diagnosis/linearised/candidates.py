"""Tangents of the candidates, a few at a time, because all of them may not fit into memory."""

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
"""Largest number of candidates whose tangents are computed together, so that a short recording's fit into the cache."""

_CELLS = 4_000_000
"""Numbers per block of tangents: 32 MB, of which a Fourier transform needs four times."""

HELD = 8_000_000
"""Numbers of candidates' tangents that are cached, 64 MB; the others are recomputed on each access."""


def in_blocks(columns: Sequence[Tensor], at_once: int = AT_ONCE) -> Iterator[list[Tensor]]:
    """Yield blocks of at most ``at_once`` matrices, or of about :data:`_CELLS` numbers.

    Example:
        >>> [len(block) for block in in_blocks([torch.ones(1000, 1)] * 10)]
        [8, 2]
        >>> [len(block) for block in in_blocks([torch.ones(1, 1).expand(1_500_000, 1)] * 4)]
        [3, 1]
    """
    block: list[Tensor] = []
    for matrix in columns:
        block.append(matrix)
        if len(block) == at_once or sum(known.numel() for known in block) >= _CELLS:
            yield block
            block = []
    if block:
        yield block


class Candidates(Sequence[Tensor]):
    """The tangents of each candidate's γ, (N, m, q); zeros if they are not finite.

    Through a pointwise port a tangent is a product, recomputed on each access except for the first :data:`HELD`
    numbers. Tangents through trajectories are solved for in parallel and cached.

    Args:
        model, parameters: where to linearise.
        terms: the candidates.
        pointwise: Jacobian through each pointwise port, (N, m, channels); None for the other ports.
    """

    def __init__(
        self,
        model: JointModel,
        parameters: Float[Tensor, " p"],
        terms: Sequence[Term],
        pointwise: Mapping[str, Tensor | None],
    ) -> None:
        self._terms, self._prepared, self._pointwise = tuple(terms), model.prepared, dict(pointwise)
        self._independent = parameters.new_tensor([float(channel) for channel in self._prepared.independent])
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
        return self._tangent(numbers) if isinstance(numbers, int) else tuple(self._tangent(k) for k in numbers)

    def __len__(self) -> int:
        return len(self._terms)

    @property
    def parts(self) -> tuple[object, ...]:
        """All large parts, itself included."""
        return (self, *self._held.values(), *self._signals.values())

    def _tangent(self, number: int) -> Tensor:
        if number in self._held:
            return self._held[number]
        term = self._terms[number]
        known, context = self._pointwise[term.port], term.context(self._prepared, self._signals.get(term.port))
        assert known is not None
        if term.effect.has_waveform and not term.effect.has_basis:
            # a gain of a waveform: all channels share it
            moved = known * term.effect.waveform(term.shape, context)[:, None, None]
        else:
            moved = torch.einsum("nmc,ncq->nmq", known, directions(term, context))
        return self._usable(term, moved)

    def _along_trajectories(
        self, model: JointModel, parameters: Tensor, port: str, members: Sequence[int]
    ) -> dict[int, Tensor]:
        """Compute the tangents of the candidates at one port by solving for their trajectories together."""
        terms = [self._terms[number] for number in members]
        courses = [directions(term, term.context(self._prepared, self._signals.get(port))) for term in terms]
        moved = through_port(model, parameters, port, torch.cat(courses, -1), None)
        parts = moved.split([course.shape[-1] for course in courses], -1)
        return {number: self._usable(term, part) for number, term, part in zip(members, terms, parts, strict=True)}

    def _usable(self, term: Term, moved: Tensor) -> Tensor:
        if term.effect.follows_signal and not all(self._prepared.independent):
            moved = self._independent[:, None] * moved
        # a candidate without a finite slope here cannot be named
        return moved if bool(moved.isfinite().all()) else torch.zeros_like(moved)


class _Chained(Sequence[Tensor]):
    def __init__(self, sets: Sequence[Sequence[Tensor]]) -> None:
        self._sets = tuple(sets)
        self._places = [(members, number) for members in self._sets for number in range(len(members))]

    @overload
    def __getitem__(self, number: int) -> Tensor: ...

    @overload
    def __getitem__(self, number: slice) -> Sequence[Tensor]: ...

    def __getitem__(self, number: int | slice) -> Tensor | Sequence[Tensor]:
        if isinstance(number, slice):
            return tuple(members[place] for members, place in self._places[number])
        members, place = self._places[number]
        return members[place]

    def __len__(self) -> int:
        return len(self._places)

    @property
    def parts(self) -> tuple[object, ...]:
        return tuple(part for members in self._sets for part in parts_of(members))


def one_after_the_other(*sets: Sequence[Tensor]) -> Sequence[Tensor]:
    """Return several sets of candidates as one sequence, whose tangents are still computed on access."""
    return _Chained(sets)


def parts_of(candidates: Sequence[Tensor]) -> tuple[object, ...]:
    """Return all large parts of a set of candidates, itself included."""
    return candidates.parts if isinstance(candidates, (Candidates, _Chained)) else tuple(candidates)
