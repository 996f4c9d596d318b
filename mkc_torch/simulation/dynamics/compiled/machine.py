"""The collocation of a traced system by machine code; the same numbers as with NumPy up to rounding."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mkc_torch.simulation.dynamics.compiled.affine import Affine
from mkc_torch.simulation.dynamics.compiled.collocation import ArrayGrid, CollocationSolution, Factor, ParameterSources
from mkc_torch.simulation.dynamics.compiled.expressions import Array
from mkc_torch.simulation.dynamics.compiled.functions import CompiledBlock, CompiledObserverJump, Derivatives
from mkc_torch.simulation.dynamics.compiled.program import Program, ProgramAt
from mkc_torch.simulation.dynamics.compiled.tape import needed_nodes
from mkc_torch.simulation.dynamics.loops.machine_code import machine_code
from mkc_torch.simulation.dynamics.loops.recurrence import pass_on

if TYPE_CHECKING:
    from mkc_torch.simulation.dynamics.compiled.traced import Traced


def machine_system(
    traced: Traced, grid: ArrayGrid, rows: NDArray[np.int64], observed: tuple[Array, Array] | None
) -> MachineSystem | None:
    """Translate a traced system to programs; None where Numba is not available.

    Args:
        traced: the system.
        grid: its grid times.
        rows: (N,), grid index of each sample.
        observed: gain (k, m, N) and clipping limit (m, N) of its observer; None without an observer.
    """
    return MachineSystem(traced, grid, rows, observed) if machine_code(pass_on) is not None else None


class MachineSystem:
    """A traced system as programs; see :func:`machine_system`."""

    def __init__(
        self, traced: Traced, grid: ArrayGrid, rows: NDArray[np.int64], observed: tuple[Array, Array] | None
    ) -> None:
        self._traced, self.grid, self.rows = traced, grid, rows
        self._stations, self._samples = (3, len(grid.step)), (1, len(rows))
        self._observer = _observer(traced, grid, rows, observed)

    def at(self, parameters: Sequence[float]) -> MachineCollocation:
        """The collocation at given parameters. The caller silences warnings of NumPy."""
        rates, slopes = self._rates
        equations = rates.at(parameters), slopes.program.at(parameters), slopes.places
        return MachineCollocation(self, parameters, equations, self._jump(parameters))

    def _jump(self, parameters: Sequence[float]) -> tuple[Any, ...]:
        if self._innovations is None:
            return _NO_PROGRAM, _NO_PROGRAM, _NO_PLACES, *self._observer
        new, slopes = self._innovations
        return new.at(parameters), slopes.program.at(parameters), slopes.places, *self._observer

    def moved_by_parameters(self, parameters: Sequence[float], states: Array) -> tuple[list[int], Array]:
        """Parameters that move the innovations, and derivatives (w, K, G) of the states after the samples by them."""
        new = self._traced.new
        if new is None or not new.moving:
            return [], np.zeros((len(states), 0, states.shape[1]))
        gain, limit, *_ = self._observer
        jump = CompiledObserverJump(
            self.rows, self._traced.places, gain, limit, new.values(parameters), new.by_states.at(parameters)
        )
        return new.moving, jump.by_parameters(states, new.by_parameters.at(parameters)(states[:, self.rows]))

    @cached_property
    def _rates(self) -> tuple[Program, _Slopes]:
        block = self._traced.ends
        return _program(block, block.nodes, self._stations), self._slopes(block, block.by_states, self._stations)

    @cached_property
    def _innovations(self) -> tuple[Program, _Slopes] | None:
        block = self._traced.new
        if block is None:
            return None
        return _program(block, block.nodes, self._samples), self._slopes(block, block.by_states, self._samples)

    @cached_property
    def by_parameters(self) -> tuple[list[int], _Slopes]:
        """Parameters that the rates depend on, and the derivatives by them."""
        block = self._traced.ends
        return block.moving, self._slopes(block, block.by_parameters, self._stations)

    def _slopes(self, block: CompiledBlock, derivatives: Derivatives, shape: tuple[int, int]) -> _Slopes:
        places = np.array(derivatives.places, dtype=np.int64).reshape(-1, 2)
        return _Slopes(_program(block, derivatives.nodes, shape), places)


@dataclass(frozen=True)
class _Slopes:
    """Derivatives that are not 0: their program, and their places in the matrix, (e, 2)."""

    program: Program
    places: NDArray[np.int64]


class MachineSteps:
    """The steps of a traced map without calls outside torch, as programs.

    Args:
        traced: the map.
        grid: the grid times.
        rows: (N,), grid index of each sample.
        observed: gain (k, m, N) and clipping limit (m, N) of its observer; None without an observer.
    """

    def __init__(
        self, traced: Traced, grid: ArrayGrid, rows: NDArray[np.int64], observed: tuple[Array, Array] | None
    ) -> None:
        self._grid = grid
        self._program = _program(traced.ends, traced.ends.nodes, (1, len(grid.step)))
        new = traced.new
        self._innovations = None if new is None else _program(new, new.nodes, (1, len(rows)))
        self._observer = _observer(traced, grid, rows, observed)

    def states(self, parameters: Sequence[float], first: Array) -> Array | None:
        """The states (w, G) from the initial states (w, K) of the trajectories; None where they diverge."""
        from mkc_torch.simulation.dynamics.loops.steps import step_through

        steps, found = machine_code(step_through), np.empty((len(first), len(self._grid.begins)))
        assert steps is not None
        innovations = _NO_PROGRAM if self._innovations is None else self._innovations.at(parameters)
        jump = innovations, *self._observer
        steps(self._program.at(parameters), jump, self._grid.step, np.ascontiguousarray(first), found)
        return found if np.isfinite(found).all() else None


def machine_steps(
    traced: Traced, grid: ArrayGrid, rows: NDArray[np.int64], observed: tuple[Array, Array] | None
) -> MachineSteps | None:
    """Translate a traced map to a program of its steps; None with calls, or where Numba is not available.

    Args:
        traced, grid, rows, observed: as in :func:`machine_system`.
    """
    blocks = [block for block in (traced.ends, traced.new) if block is not None]
    usable = not any(_calls(block) for block in blocks) and machine_code(pass_on) is not None
    return MachineSteps(traced, grid, rows, observed) if usable else None


def _calls(block: CompiledBlock) -> bool:
    """Whether a block needs a function outside torch."""
    nodes = block.expressions.nodes
    return any(nodes[node].operation == "values" for node in needed_nodes(block.expressions, block.nodes))


def _program(block: CompiledBlock, nodes: Sequence[int], shape: tuple[int, int]) -> Program:
    from mkc_torch.simulation.dynamics.loops.programs import CODES

    return Program(block.expressions, nodes, block.states, shape, CODES)


def _observer(
    traced: Traced, grid: ArrayGrid, rows: NDArray[np.int64], observed: tuple[Array, Array] | None
) -> tuple[Array, Array, NDArray[np.int64], NDArray[np.int64]]:
    """Gain, limit, corrected states and the sample of each grid time, or -1; empty without an observer."""
    gain, limit = (np.empty((0, 0, 0)), np.empty((0, 0))) if observed is None else observed
    sample = np.full(0 if observed is None else len(grid.begins), -1)
    if observed is not None:
        sample[rows] = np.arange(len(rows))
    return gain, limit, np.array(traced.places, dtype=np.int64), sample


_NO_PROGRAM: ProgramAt = np.zeros((0, 5), np.int64), np.empty(0), np.empty((0, 0, 0)), np.zeros(0, np.int64), 0
_NO_PLACES = np.zeros((0, 2), np.int64)
_NONE = np.empty((0, 0, 0))


class MachineCollocation:
    """The collocation of a :class:`MachineSystem` at given parameters; implements :class:`..collocation.Collocation`.

    Args:
        system: the system.
        parameters: the parameters.
        equations, jump: as in :mod:`mkc_torch.simulation.dynamics.loops.equations`.
    """

    def __init__(
        self, system: MachineSystem, parameters: Sequence[float], equations: tuple[Any, ...], jump: tuple[Any, ...]
    ) -> None:
        self._system, self._parameters = system, parameters
        self._known = equations, jump, system.grid.step

    def solved(self, guess: Array, factor: Factor | None = None) -> CollocationSolution | None:
        states = np.array(guess, order="C")
        carries, inverse = self._empty(states) if factor is None else _copies(factor)
        converged = _compiled().solve(*self._known, states, carries, inverse, factor is None)
        return CollocationSolution(states, self._factor(carries, inverse)) if converged else None

    def solved_to(self, states: Array, inside: NDArray[np.bool_]) -> tuple[Array | None, bool]:
        found = np.array(states, order="C")
        finite, converged = _compiled().solve_roughly(*self._known, found, inside)
        return found if finite else None, converged

    def sources(self, states: Array) -> ParameterSources:
        w, G = states.shape
        carries, inverse = self._empty(states)
        behind, bend, middle = np.empty((w, w, G - 1)), np.empty((w, w, G - 1)), np.empty((w, G - 1))
        after = np.empty((w, G))
        _compiled().linearise(*self._known, states, carries, inverse, behind, bend, middle, after)
        rated, slopes = self._system.by_parameters
        moving, moved = self._system.moved_by_parameters(self._parameters, states)
        parameters = [*rated, *(k for k in moving if k not in rated)]
        shift = np.zeros((w, len(parameters), G)) if moving else _NONE
        if moving:
            shift[:, [parameters.index(k) for k in moving]] = moved
        source = np.empty((w, len(parameters), G))
        _compiled().sources(
            slopes.program.at(self._parameters), slopes.places, self._system.grid.step, states, after, middle, bend,
            inverse, shift, behind, source,
        )  # fmt: skip
        return ParameterSources(parameters, source, self._factor(carries, inverse))

    def _empty(self, states: Array) -> tuple[Array, Array]:
        w, G = states.shape
        return np.empty((w, w, G)), np.empty((w, w, G - 1))

    def _factor(self, carries: Array, inverse: Array) -> Factor:
        return Factor(Affine.of(carries, self._system.grid.longest), inverse)


def _copies(factor: Factor) -> tuple[Array, Array]:
    """The linearised equations, to be overwritten."""
    assert factor.inverse is not None
    return factor.affine.carries[0].copy(), factor.inverse.copy()


class _Loops(NamedTuple):
    solve: Callable[..., bool]
    solve_roughly: Callable[..., tuple[bool, bool]]
    linearise: Callable[..., None]
    sources: Callable[..., None]


@cache
def _compiled() -> _Loops:
    from mkc_torch.simulation.dynamics.loops.collocation import solve_equations, solve_roughly
    from mkc_torch.simulation.dynamics.loops.equations import linearise_equations, parameter_sources

    plain = solve_equations, solve_roughly, linearise_equations, parameter_sources
    found = [machine_code(loop) for loop in plain]
    return _Loops(*(loop for loop in found if loop is not None))
