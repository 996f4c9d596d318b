"""The collocation of a traced system with NumPy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mkc_torch.simulation.dynamics.compiled.affine import multiplied
from mkc_torch.simulation.dynamics.compiled.collocation import (
    ArrayGrid,
    CollocationSolution,
    Factor,
    Functions,
    ParameterSources,
    linearised,
    solved,
    solved_to,
)
from mkc_torch.simulation.dynamics.compiled.expressions import Array
from mkc_torch.simulation.dynamics.compiled.functions import CompiledObserverJump

if TYPE_CHECKING:
    from mkc_torch.simulation.dynamics.compiled.traced import Traced


class ArraySystem:
    """A traced system on a grid.

    Args:
        traced: the system.
        grid: its grid times.
        rows: (N,), grid index of each sample.
        observed: gain (k, m, N) and clipping limit (m, N) of its observer; None without an observer.
    """

    def __init__(
        self, traced: Traced, grid: ArrayGrid, rows: NDArray[np.int64], observed: tuple[Array, Array] | None
    ) -> None:
        self.traced, self.grid, self._rows, self._observed = traced, grid, rows, observed

    def at(self, parameters: Sequence[float]) -> ArrayCollocation:
        """The collocation at given parameters."""
        return ArrayCollocation(self, parameters, self._functions(parameters))

    def _functions(self, values: Sequence[float]) -> Functions:
        known, jump = self.traced, None
        if known.new is not None and self._observed is not None:
            new, new_slope = known.new.values(values), known.new.by_states.at(values)
            jump = CompiledObserverJump(self._rows, known.places, *self._observed, new, new_slope)
        return Functions(
            known.ends.values(values),
            known.middle.values(values),
            known.ends.by_states.at(values),
            known.middle.by_states.at(values),
            jump,
        )

    def innovations_by_parameters(self, values: Sequence[float], states: Array) -> Array:
        """Derivatives of the innovations by the parameters that move them, (m, K, N)."""
        assert self.traced.new is not None
        return self.traced.new.by_parameters.at(values)(states[:, self._rows])


class ArrayCollocation:
    """The collocation of an :class:`ArraySystem` at given parameters; a :class:`..collocation.Collocation`."""

    def __init__(self, system: ArraySystem, parameters: Sequence[float], functions: Functions) -> None:
        self._system, self._parameters, self._functions = system, parameters, functions

    def solved(self, guess: Array, factor: Factor | None = None) -> CollocationSolution | None:
        return solved(self._functions, self._system.grid, guess, factor)

    def solved_to(self, states: Array, inside: NDArray[np.bool_]) -> tuple[Array | None, bool]:
        return solved_to(self._functions, self._system.grid, states, inside)

    def sources(self, states: Array) -> ParameterSources:
        linear = linearised(self._functions, self._system.grid, states)
        traced, values, h = self._system.traced, self._parameters, self._system.grid.step
        ends, middle, new = traced.ends, traced.middle, traced.new
        rated = ends.moving
        seen = [] if new is None else [k for k in new.moving if k not in rated]
        parameters = [*rated, *seen]
        defects = np.zeros((len(states), len(parameters), len(h)))
        by_ends = ends.by_parameters.at(values)(linear.ends)
        left = by_ends[:, :, 0]
        if self._system.grid.maps:
            defects[:, : len(rated)] = -h * left
        else:
            right = by_ends[:, :, 1]
            moved = multiplied(linear.middle_slope, 0.125 * h * (left - right))
            by_middle = middle.by_parameters.at(values)(linear.middle)
            defects[:, : len(rated)] = -h / 6.0 * (left + 4.0 * (by_middle + moved) + right)
        if new is not None and new.moving:
            assert isinstance(self._functions.jump, CompiledObserverJump)
            by_new = self._system.innovations_by_parameters(values, states)
            after = self._functions.jump.by_parameters(states, by_new)[..., :-1]
            places = [parameters.index(k) for k in new.moving]
            defects[:, places] += np.where(h > 0, multiplied(linear.behind, after), 0.0)
        source = np.zeros((len(states), len(parameters), states.shape[1]))
        source[..., 1:] = linear.factor.cancelled(defects)
        return ParameterSources(parameters, source, linear.factor)
