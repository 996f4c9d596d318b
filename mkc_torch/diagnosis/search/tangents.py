"""Tangents of the residual by the simulation's parameters and by candidates, computed for a few at a time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, overload

import torch
from torch import Tensor

from mkc_torch._support.forward_mode import forward_jacobian
from mkc_torch.diagnosis.model.joint import JointModel, directions, port_jacobian, through_port
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.noise.spectrum import cosines, course_of, dct, dct_of_courses
from mkc_torch.diagnosis.settings import NoiseSettings
from mkc_torch.nonlinear import NoFitError

if TYPE_CHECKING:
    from jaxtyping import Float

AT_ONCE = 8
"""Largest number of candidates whose tangents are computed together, so that a short recording's fit into the cache."""

CELLS = 4_000_000
"""Numbers per block of tangents: 32 MB, of which a Fourier transform needs four times."""

HELD = 8_000_000
"""Numbers of candidates' tangents that are cached, 64 MB; the others are recomputed on each access."""


def in_blocks(columns: Sequence[Tensor], at_once: int = AT_ONCE) -> Iterator[list[Tensor]]:
    """Yield blocks of at most ``at_once`` matrices, or of about :data:`CELLS` numbers.

    Example:
        >>> [len(block) for block in in_blocks([torch.ones(1000, 1)] * 10)]
        [8, 2]
        >>> [len(block) for block in in_blocks([torch.ones(1, 1).expand(1_500_000, 1)] * 4)]
        [3, 1]
    """
    block: list[Tensor] = []
    for matrix in columns:
        block.append(matrix)
        if len(block) == at_once or sum(known.numel() for known in block) >= CELLS:
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
        if model.prepared.observer is not None:
            # along a corrected trajectory they would read the recording ahead
            free = [number for number, term in enumerate(self._terms) if term.effect.open_loop_only]
            self._held |= {number: self._zeros(self._terms[number]) for number in free}
        for name, known in self._pointwise.items():
            members = [k for k, term in enumerate(self._terms) if term.port == name and k not in self._held]
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

    def _zeros(self, term: Term) -> Tensor:
        context = term.context(self._prepared, self._signals.get(term.port))
        return context.time.new_zeros(len(self._prepared.time), len(self._independent), term.size(context))

    def _usable(self, term: Term, moved: Tensor) -> Tensor:
        if term.effect.follows_signal and not all(self._prepared.independent):
            moved = self._independent[:, None] * moved
        # a candidate without a finite slope here cannot be named
        return moved if bool(moved.isfinite().all()) else torch.zeros_like(moved)


def open_loop_tangents(
    model: JointModel, parameters: Float[Tensor, " p"], terms: Sequence[Term]
) -> tuple[Float[Tensor, "N m q"], ...]:
    """Return the tangents of candidates along the open loop of a model, in units of the outputs.

    Args:
        model: in open loop, or with an observer, which is left out.
        parameters: of the model.
        terms: the candidates.
    """
    prepared = model.prepared.open_loop()
    free = JointModel(prepared, model.terms)
    return tuple(Candidates(free, parameters, terms, dict.fromkeys(prepared.ports)))


class _Chained(Sequence[Tensor]):
    def __init__(self, sets: Sequence[Sequence[Tensor]]) -> None:
        self._places = [(members, number) for members in sets for number in range(len(members))]

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


def one_after_the_other(*sets: Sequence[Tensor]) -> Sequence[Tensor]:
    """Return several sets of candidates as one sequence, whose tangents are still computed on access."""
    return _Chained(sets)


@dataclass(frozen=True)
class ModelTangents:
    """The tangents of a residual.

    Attributes:
        nuisance: of the parameters, (N, m, p).
        candidates: of each candidate's γ, (N, m, q); for long recordings computed on access.
        pointwise: through each pointwise port, (N, m, channels); None for the other ports.
        slow: of slow cosines at the port with a drift; None without such a port.
    """

    nuisance: Float[Tensor, "N m p"]
    candidates: Sequence[Float[Tensor, "N m q"]]
    pointwise: dict[str, Tensor | None]
    slow: SlowBasis | None

    @property
    def bare(self) -> ModelTangents:
        """The tangents without candidates."""
        return replace(self, candidates=())


@dataclass(frozen=True)
class SlowBasis:
    """Slow cosines of a port's channels, and their standard deviations in each drift family (F, k).

    ``tangents`` are those of each cosine of each channel, (N, m, k); at a ``pointwise`` port those of the channels,
    (N, m, c), which the cosines modulate. Another family than the first has to gain ``walk_first`` nats more.
    """

    port: str
    channels: int
    tangents: Tensor
    pointwise: bool
    scales: Tensor
    walk_first: float

    @property
    def count(self) -> int:
        """Number of cosines per channel."""
        return self.scales.shape[1] // self.channels

    def transformed(self, counts: Float[Tensor, "N m"], kept: int) -> Float[Tensor, "K m k"]:
        """Return the K slowest cosine coefficients of the tangents at the samples that count."""
        moved = counts.unsqueeze(-1) * self.tangents
        return dct_of_courses(moved, self.count, kept) if self.pointwise else dct(moved, kept)

    def waveform(self, amplitudes: Float[Tensor, " k"]) -> Float[Tensor, "N m"]:
        """Return the residual's change by cosines of these amplitudes, (N, m)."""
        if not self.pointwise:
            return self.tangents @ amplitudes
        drift = course_of(amplitudes.unflatten(0, (-1, self.channels)), len(self.tangents))
        return torch.einsum("nmc,nc->nm", self.tangents, drift)

    def with_shares(self, shares: Float[Tensor, " c"]) -> SlowBasis:
        """Return the basis with the variance of each channel scaled."""
        return replace(self, scales=self.scales * shares.sqrt().repeat(self.scales.shape[1] // len(shares)))

    def of_family(self, number: int) -> SlowBasis:
        """Return the basis with one drift family only."""
        return replace(self, scales=self.scales[number : number + 1])


def tangents_of(
    model: JointModel, parameters: Float[Tensor, " p"], settings: NoiseSettings, terms: Sequence[Term] = ()
) -> ModelTangents:
    """Compute the tangents at these parameters, by forward mode.

    Args:
        model, parameters: where to linearise.
        settings: the drift families.
        terms: candidates.

    Raises:
        NoFitError: the residual has no finite derivative by a parameter there.
    """
    prepared, model = model.prepared, model.around(parameters)
    pointwise = {
        name: port_jacobian(model, parameters, name) if port.pointwise else None
        for name, port in prepared.ports.items()
    }
    independent = parameters.new_tensor([float(channel) for channel in prepared.independent])
    values = len(prepared.time) * len(prepared.independent)
    nuisance = forward_jacobian(model.residual, parameters, values)
    if not bool(nuisance.isfinite().all()):
        effects = [
            f"the size of {t.effect.id}" for t, n in zip(model.terms, model.sizes, strict=True) for _ in range(n)
        ]
        finite = nuisance.isfinite().flatten(0, 1).all(0).tolist()
        names = zip((*prepared.parameter_names, *effects), finite, strict=True)
        lost = dict.fromkeys(name for name, known in names if not known)
        raise NoFitError(
            f"The simulation's outputs have no finite derivative by {', '.join(lost)} at the fitted values. Bound "
            "these parameters, or start them elsewhere."
        )
    start = model.base
    for term, size in zip(model.terms, model.sizes, strict=True):
        if term.effect.follows_signal:
            nuisance[..., start : start + size] *= independent[:, None]
        start += size
    slow = _slow_courses(model, parameters, pointwise, settings)
    return ModelTangents(nuisance, Candidates(model, parameters, terms, pointwise), pointwise, slow)


def _slow_courses(
    model: JointModel, parameters: Tensor, pointwise: dict[str, Tensor | None], settings: NoiseSettings
) -> SlowBasis | None:
    N = len(model.prepared.time)
    count = min(settings.slow_courses, N // 10)
    drifting = [name for name, port in model.prepared.ports.items() if port.allows_drift]
    if not drifting or count == 0:
        return None
    name = drifting[0]
    c = len(model.prepared.ports[name].channels)
    k = torch.arange(1, count + 1, dtype=parameters.dtype).repeat_interleave(c)
    others = ((1.0 + (k / corner).square()).reciprocal() + (walk / k).square() for corner, walk in settings.plateaus)
    scales = torch.stack([1.0 / k, *(square.sqrt() for square in others)])
    known = pointwise[name]
    if known is not None:
        return SlowBasis(name, c, known, True, scales, settings.walk_first)
    courses = cosines(count, N)
    eye = torch.eye(c, dtype=courses.dtype)
    spread = (courses[:, None, :, None] * eye[:, None, :]).reshape(N, c, count * c)
    return SlowBasis(name, c, through_port(model, parameters, name, spread, None), False, scales, settings.walk_first)
