"""Values and derivatives of a stepper's map at many points, by batches of steps."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from mkc_torch.simulation.foreign.evaluation import CachedEvaluation, EvaluationPoints, Group
from mkc_torch.simulation.names import Names
from mkc_torch.simulation.parameter import Parameter, SimulationError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

_STEP = float(np.finfo(np.float64).eps) ** 0.5
"""Relative step of a one-sided difference, at which the errors by rounding and by curvature are similar."""

_NEAR = 1e-3
"""Distance of points, as a share of each state, input and parameter, over which derivatives are the same."""

_CLOSE = 0.1
"""Distance of neighbouring points, as a share of each state and input, over which derivatives are interpolated."""

_FEW = 2000
"""Number of points below which each has derivatives of its own."""

_REMEMBERED = 8
"""Number of courses whose derivatives are kept, the last used: fits with different effects begin from the same."""

_BATCH = 200_000
"""Most steps in one call."""


SingleStep = Callable[[Sequence[float], Sequence[float], Sequence[float], Names], Sequence[float]]
"""The states after a step, from the states, the inputs, the forces, and the parameters and constants."""

_Slopes = dict[tuple[bool, Group, int], "Array"]
"""Derivatives by outputs or rates, group and number of the variable."""


class Steps(Protocol):
    """The functions of a stepper."""

    time_step: float
    forces: Mapping[str, str]

    @property
    def name(self) -> str: ...
    def step(self, x: Array, u: Array, tau: Array, p: Names, dt: float) -> Array: ...
    def sensed(self, x: Array, u: Array, p: Names) -> Mapping[str, Array]: ...
    def single(self) -> SingleStep | None: ...


class StepperEvaluation(CachedEvaluation):
    """The change of a stepper's states over one step divided by its length, and its outputs.

    Args:
        stepper: the simulation.
        states, inputs, parameters: names in the order of the arrays; after the inputs come the forces, and then the
            changes of the constants.
        shown: names of the outputs that are no states.
        constants: by name, in the order of their changes.
    """

    def __init__(
        self,
        stepper: Steps,
        states: tuple[str, ...],
        inputs: tuple[str, ...],
        parameters: tuple[str, ...],
        shown: tuple[str, ...] = (),
        constants: Mapping[str, Parameter] = MappingProxyType({}),
    ) -> None:
        super().__init__()
        self.stepper, self.shown, self.constants = stepper, shown, dict(constants)
        self._slopes: deque[tuple[EvaluationPoints, _Slopes]] = deque(maxlen=_REMEMBERED)
        self._compared: tuple[EvaluationPoints, _Slopes] | None = None
        self.states, self.inputs, self.parameters = states, inputs, parameters

    def __getstate__(self) -> tuple[object, ...]:
        return self.stepper, self.states, self.inputs, self.parameters, self.shown, self.constants

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        StepperEvaluation.__init__(self, *state)

    def count(self, outputs: bool) -> int:
        return len(self.shown) if outputs else len(self.states)

    def fresh(self, outputs: bool, rows: tuple[Array, Array, Array], parameters: Array) -> Array:
        _, states, given = rows
        found = np.empty((len(states), self.count(outputs)))
        for first in range(0, len(states), _BATCH):
            part = slice(first, first + _BATCH)
            found[part] = self._with_constants(outputs, states[part], given[part], parameters)
        return found

    def changed(self, change: Array) -> dict[str, float] | None:
        """The constants after a change of each, (c,); None where a constant leaves its bounds."""
        found = {
            name: known.value + float(by) for (name, known), by in zip(self.constants.items(), change, strict=True)
        }
        within = all(known.lower <= found[name] <= known.upper for name, known in self.constants.items())
        return found if within else None

    def _with_constants(self, outputs: bool, states: Array, given: Array, parameters: Array) -> Array:
        """The values at states and inputs; one call for all points with the same constants."""
        named = dict(zip(self.parameters, parameters.tolist(), strict=True))
        first = given.shape[1] - len(self.constants)
        found, changes = np.full((len(states), self.count(outputs)), np.nan), given[:, first:]
        if (changes == changes[:1]).all():  # nearly always; sorting them costs as much as the steps
            different, group = changes[:1], np.zeros(len(changes), dtype=int)
        else:
            different, group = np.unique(changes, axis=0, return_inverse=True)
        for k, change in enumerate(different):
            rows, constants = group.reshape(-1) == k, self.changed(change)
            if constants is not None:
                found[rows] = self._at(outputs, states[rows], given[rows, :first], Names(**named, **constants))
        return found

    def single(self) -> Callable[[Sequence[float], Sequence[float], Sequence[float]], Sequence[float]] | None:
        """A function from states, inputs and parameters to the rates at a point; None without fast single steps."""
        step = self.stepper.single()
        if step is None:
            return None
        first, m = len(self.inputs) + len(self.stepper.forces), len(self.inputs)
        h, failed = self.stepper.time_step, [np.nan] * len(self.states)
        known: dict[tuple[float, ...], Names | None] = {}

        def rates(states: Sequence[float], inputs: Sequence[float], parameters: Sequence[float]) -> Sequence[float]:
            changes = (*inputs[first:], *parameters)
            if changes not in known:
                constants = self.changed(np.asarray(inputs[first:]))
                named = dict(zip(self.parameters, parameters, strict=True))
                known[changes] = None if constants is None else Names(**named, **constants)
            p = known[changes]
            if p is None:
                return failed
            return [(b - a) / h for a, b in zip(states, step(states, inputs[:m], inputs[m:first], p), strict=True)]

        return rates

    def slopes(self, outputs: bool, at: EvaluationPoints, group: Group) -> Array:
        """Derivatives by each variable of a group, (S, k, size of the group); as in :meth:`slope`."""
        size = {"states": at.parts[1], "inputs": at.parts[2], "parameters": at.parts[3]}[group].shape[-1]
        slopes = [self.slope(outputs, at, group, number) for number in range(size)]
        return np.stack(slopes, -1) if slopes else np.empty((len(at.parts[0]), self.count(outputs), 0))

    def slope(self, outputs: bool, at: EvaluationPoints, group: Group, number: int) -> Array:
        """Derivatives by a variable of a group, (S, k); those of points nearby where known.

        They are differences of many steps, and change no value: only how fast a solution converges. Along a long
        course of small steps they are interpolated.
        """
        known, key = self._slopes_near(at), (outputs, group, number)
        if key not in known:
            places = _along(at)
            base = self.values(outputs, at)[places]
            found = self.columns(outputs, at.rows(places), at.parts[3], group, [number], base)[..., 0]
            known[key] = _between(found, places, len(at.parts[0]))
        return known[key]

    def _slopes_near(self, at: EvaluationPoints) -> _Slopes:
        """The known derivatives at points or nearby; the derivatives by many variables ask in turn."""
        if self._compared is None or self._compared[0] is not at:
            near = [place for place, (points, _) in enumerate(self._slopes) if at.near(points, _NEAR)]
            points, known = self._slopes[near[-1]] if near else (at, {})
            if near:
                del self._slopes[near[-1]]
            self._slopes.append((points, known))
            self._compared = at, known
        return self._compared[1]

    def columns(
        self,
        outputs: bool,
        rows: tuple[Array, Array, Array],
        given: Array,
        group: Group,
        numbers: Sequence[int],
        base: Array,
    ) -> Array:
        time, states, inputs = rows
        if group == "parameters":
            moved = {k: _moved(given, k, _STEP * (abs(given[k]) or 1.0)) for k in numbers}
            changes = {k: self.fresh(outputs, rows, values) - base for k, values in moved.items()}
            return _stacked([change / (moved[k][k] - given[k]) for k, change in changes.items()], base)
        table = states if group == "states" else inputs
        slopes = []
        for k in numbers:
            moved_table = _moved(table.T, k, _difference(table[:, k])).T
            pair = (moved_table, inputs) if group == "states" else (states, moved_table)
            with np.errstate(invalid="ignore"):  # where the simulation fails
                change = self.fresh(outputs, (time, *pair), given) - base
            slopes.append(change / (moved_table[:, [k]] - table[:, [k]]))
        return _stacked(slopes, base)

    def _at(self, outputs: bool, states: Array, given: Array, p: Names) -> Array:
        stepper, m = self.stepper, len(self.inputs)
        u, tau = given[:, :m], given[:, m:]
        if outputs:
            shown: Mapping[str, Array] = stepper.sensed(states, u, p)
            return np.stack([np.broadcast_to(shown[name], len(states)) for name in self.shown], 1)
        after = np.asarray(stepper.step(states, u, tau, p, stepper.time_step), np.float64)
        if after.shape != states.shape:
            raise SimulationError(
                f"{stepper.name}.step: expected states of shape {states.shape}, like x, but got {after.shape}."
            )
        return np.asarray((after - states) / stepper.time_step)


def _along(at: EvaluationPoints) -> NDArray[np.int64]:
    """The points between which derivatives are interpolated; with the first and the last, and both sides of a jump."""
    if len(at.parts[0]) < _FEW:
        return np.arange(len(at.parts[0]))
    table = np.concatenate(at.parts[1:3], 1)
    size = np.sqrt(np.square(table).mean(0))
    with np.errstate(all="ignore"):  # points that a diverging solution reached
        moves = (np.abs(np.diff(table, axis=0)) / np.where(size > 0.0, size, 1.0)).max(1, initial=0.0)
    moves = np.where(moves < _CLOSE, moves, 2.0 * _CLOSE)
    kept = np.ones(len(table), dtype=bool)
    kept[1:-1] = np.diff(np.floor(np.cumsum(moves) / _CLOSE), prepend=0.0)[:-1] > 0
    kept[:-1] |= moves >= _CLOSE
    return np.flatnonzero(kept)


def _between(values: Array, places: NDArray[np.int64], count: int) -> Array:
    """Values (p, k) at some of the points, interpolated to all, (count, k)."""
    if len(places) == count:
        return values
    at = np.arange(count)
    after = np.searchsorted(places, at).clip(1, len(places) - 1)
    first, last = places[after - 1], places[after]
    share = ((at - first) / (last - first))[:, None]
    return (1.0 - share) * values[after - 1] + share * values[after]


def _moved(values: Array, place: int, step: float) -> Array:
    """A copy with a step added to the values at one place of the first axis."""
    found = values.copy()
    found[place] += step
    return found


def _stacked(slopes: Sequence[Array], base: Array) -> Array:
    return np.stack(slopes, -1) if slopes else np.empty((*base.shape, 0))


def _difference(values: Array) -> float:
    """A step for a whole column by its mean absolute value, because a value near 0 has no scale."""
    size = float(np.abs(values).mean()) if len(values) else 1.0
    return _STEP * (size if np.finfo(size).tiny < _STEP * size < np.inf else 1.0)
