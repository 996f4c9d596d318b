"""Values and derivatives of functions outside torch at many points, with a cache of the last results."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

Group = Literal["states", "inputs", "parameters"]
GROUPS: tuple[Group, ...] = ("states", "inputs", "parameters")

_REMEMBERED = 8
"""Number of cached results, the last used: Newton's method repeats its last points, and a fit its final point."""


class EvaluationPoints:
    """Times (S,), states (S, n), inputs (S, m) and parameters (p,), as contiguous arrays."""

    def __init__(self, time: Array, states: Array, inputs: Array, parameters: Array) -> None:
        self.parts = tuple(np.ascontiguousarray(part, np.float64) for part in (time, states, inputs, parameters))

    def __eq__(self, other: object) -> bool:
        if self is other:
            return True
        return isinstance(other, EvaluationPoints) and all(map(np.array_equal, self.parts, other.parts))

    __hash__ = None  # type: ignore[assignment]

    def new(self) -> NDArray[np.bool_]:
        """(S,), whether a point differs from the previous one: the end of an interval is the start of the next."""
        table = np.concatenate([self.parts[0][:, None], *self.parts[1:3]], 1)
        new = np.ones(len(table), np.bool_)
        new[1:] = (table[1:] != table[:-1]).any(1)
        return new

    def same(self, other: EvaluationPoints) -> NDArray[np.bool_]:
        """(S,), which points equal those of ``other``, such as the ends of intervals whose middles have moved."""
        if len(other.parts[0]) != len(self.parts[0]) or not np.array_equal(self.parts[3], other.parts[3]):
            return np.zeros(len(self.parts[0]), np.bool_)
        alike = self.parts[0] == other.parts[0]
        for k in (1, 2):
            alike &= (self.parts[k] == other.parts[k]).all(1)
        return alike

    def near(self, other: EvaluationPoints, share: float) -> bool:
        """Whether all points are those of ``other`` within a share of the size of each column and parameter."""
        pairs = zip(self.parts[1:], other.parts[1:], strict=True)
        with np.errstate(all="ignore"):  # a state that diverges is near to none
            return all(
                own.shape == known.shape and bool((np.abs(own - known) <= share * _size(known)).all())
                for own, known in pairs
            )

    def rows(self, which: Any) -> tuple[Array, Array, Array]:
        """Times, states and inputs of some of the points."""
        time, states, inputs, _ = self.parts
        return tuple(np.ascontiguousarray(part[which]) for part in (time, states, inputs))  # type: ignore[return-value]


def _size(values: Array) -> Array:
    """Root mean square of each column of a table; the size of each value of a list."""
    return np.abs(values) if values.ndim == 1 else np.sqrt(np.square(values).mean(0))


class CachedEvaluation(ABC):
    """A simulation outside torch as a function of time, states, inputs and parameters that returns rates or outputs.

    A derived class defines ``count``, ``fresh`` and ``columns``.
    """

    def __init__(self) -> None:
        self._last: dict[bool, tuple[EvaluationPoints, Array]] = {}
        self._known: deque[tuple[Any, EvaluationPoints, Array]] = deque(maxlen=_REMEMBERED)

    @abstractmethod
    def count(self, outputs: bool) -> int:
        """Number of rates, or of outputs."""

    @abstractmethod
    def fresh(self, outputs: bool, rows: tuple[Array, Array, Array], parameters: Array) -> Array:
        """The rates or the outputs, (S, k), computed at times (S,), states (S, n) and inputs (S, m)."""

    @abstractmethod
    def columns(
        self,
        outputs: bool,
        rows: tuple[Array, Array, Array],
        given: Array,
        group: Group,
        numbers: Sequence[int],
        base: Array,
    ) -> Array:
        """Derivatives by some variables of a group, (S, k, numbers); ``base`` are the values there."""

    def values(self, outputs: bool, at: EvaluationPoints) -> Array:
        """The rates of the states, or the outputs, (S, k); NaN where the simulation fails."""

        def computed() -> Array:
            new = at.new()
            before, known = self._last.get(outputs, (None, None))
            same = at.same(before) if before is not None else np.zeros_like(new)
            missing = new & ~same
            found = np.empty((len(new), self.count(outputs)))
            if known is not None and same.any():
                found[same] = known[same]
            found[missing] = self.fresh(outputs, at.rows(missing), at.parts[3])
            found = found[np.maximum.accumulate(np.where(new, np.arange(len(new)), 0))]
            self._last[outputs] = at, found
            return found

        return self._cached(("values", outputs), at, computed)

    def slopes(self, outputs: bool, at: EvaluationPoints, group: Group) -> Array:
        """Derivatives of rates or outputs by each variable of a group, (S, k, size of the group)."""

        numbers = range({"states": at.parts[1], "inputs": at.parts[2], "parameters": at.parts[3]}[group].shape[-1])
        return self._cached(("slopes", outputs, group), at, lambda: self._slopes_by(outputs, at, group, numbers))

    def _slopes_by(self, outputs: bool, at: EvaluationPoints, group: Group, numbers: Sequence[int]) -> Array:
        new = at.new()
        base = self.values(outputs, at)[new]
        return self.columns(outputs, at.rows(new), at.parts[3], group, numbers, base)[new.cumsum() - 1]

    def _cached(self, what: Any, at: EvaluationPoints, compute: Callable[[], Array]) -> Array:
        for place, (known, moments, answer) in enumerate(self._known):
            if known == what and moments == at:
                del self._known[place]
                self._known.append((known, moments, answer))
                return answer
        found = compute()
        self._known.append((what, at, found))
        return found
