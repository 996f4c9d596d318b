"""Trace a prepared system of differential equations to expressions of states and parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
import torch
from torch import Tensor

from mkc_torch.simulation.continuation import Meaning
from mkc_torch.simulation.dynamics.compiled.expressions import Array, Expressions
from mkc_torch.simulation.dynamics.compiled.functions import CompiledBlock
from mkc_torch.simulation.dynamics.compiled.operations import OPERATIONS
from mkc_torch.simulation.dynamics.compiled.symbol import (
    Symbol,
    Trace,
    UntraceableError,
    as_nodes,
    course_symbol,
    parameter_symbol,
    state_symbol,
)
from mkc_torch.simulation.dynamics.missing import MissingOutputs
from mkc_torch.simulation.dynamics.observer import ObserverJump
from mkc_torch.simulation.dynamics.rollout import Stepping
from mkc_torch.simulation.dynamics.trajectory import Grid
from mkc_torch.simulation.dynamics.varying import Acting
from mkc_torch.simulation.names import Names
from mkc_torch.simulation.ports import Changes

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_FEWEST = 16
"""Smallest number of samples, plus the number of parameters, that distinguishes the time axis from other axes."""


class Traceable(Stepping, Protocol):
    """The interface of a prepared system that tracing uses.

    Attributes:
        rows: (N,), grid index of each sample.
        begins: (N,), True where a run starts.
        measured: (N, m), the recorded outputs.
        missing: where outputs are missing; None where none is.
        guess: (G, n), a first guess of the states.
        inputs: (S, u), the recorded inputs at the stations.
    """

    rows: Int[Tensor, " N"]
    begins: Bool[Tensor, " N"]
    measured: Float[Tensor, "N m"]
    missing: MissingOutputs | None
    guess: Float[Tensor, "G n"]
    inputs: Float[Tensor, "S u"]

    def first_states(self, theta: Tensor, changes: Changes) -> tuple[Tensor, list[str]]: ...
    def with_memories(self, states: Tensor, memories: Sequence[str]) -> Tensor: ...
    def acting_inputs(self, theta: Tensor, changes: Changes) -> Tensor: ...
    def acting_parameters(self, theta: Tensor, changes: Changes) -> Names: ...
    def acts_on_outputs(self, changes: Changes) -> bool: ...
    def inputs_at_samples(self, theta: Tensor, changes: Changes) -> Tensor: ...
    def parameters_at_samples(self, theta: Tensor, changes: Changes) -> Names: ...
    def parameters_of(self, theta: Tensor) -> Names: ...
    def rate(self, theta: Tensor, changes: Changes, acting: Acting | None = None) -> Callable[[Tensor], Tensor]: ...
    def jump(self, theta: Tensor, changes: Changes, acting: Acting | None = None) -> ObserverJump | None: ...
    def outputs_by_states(
        self, theta: Tensor, changes: Changes, states: Tensor, acting: Acting | None = None
    ) -> Tensor: ...


@dataclass(frozen=True)
class Traced:
    """The functions of a system as expressions.

    Attributes:
        memories: the state that each internal state starts equal to; empty to start at 0.
        first: initial states of the runs, K w nodes.
        ends, middle: rates at the ends (2, G-1) and in the middle (G-1,) of each interval; those of a simulation that
            steps are at the left ends (1, G-1).
        new: innovations of an observer at the samples; None without an observer.
        outputs: outputs at the samples; None where they cannot be traced, as with effects across samples.
        places: indices of the states that an observer corrects.
    """

    memories: Sequence[str]
    first: CompiledBlock
    ends: CompiledBlock
    middle: CompiledBlock
    new: CompiledBlock | None
    outputs: CompiledBlock | None
    places: Sequence[int]

    @property
    def width(self) -> int:
        """Number of states, including internal states."""
        return len(self.ends.nodes)


def traced(system: Traceable, meaning: Meaning, size: int) -> Traced | None:
    """Trace the functions of a system; None where a function cannot be traced.

    Args:
        system: the prepared system.
        meaning: maps the parameters to the simulation's own parameters and the changes at its ports.
        size: number of parameters.
    """
    stations, samples = len(system.grid.stations), len(system.measured)
    if system.grid.time.dtype != torch.float64 or system.grid.time.device.type != "cpu" or samples < _FEWEST + size:
        return None
    try:
        return _traced(system, meaning, size, stations, samples)
    # a user's function may raise anything on a symbol; torch computes the function instead, or raises again
    except Exception:
        return None


def _traced(system: Traceable, meaning: Meaning, size: int, stations: int, samples: int) -> Traced:
    e = Expressions()
    trace = Trace(e, frozenset((stations, samples)), OPERATIONS)
    parameters = parameter_symbol(trace, size)
    theta, changes = meaning(parameters)
    begin, memories = system.first_states(theta, changes)
    width = begin.shape[1]
    leaves = [e.leaf("state", k) for k in range(width)], [e.leaf("parameter", k) for k in range(size)]

    def block(value: Tensor, length: int, arranged: Callable[[Array], Array]) -> CompiledBlock:
        nodes, shape, time_axis = as_nodes(value, trace)
        if len(shape) != 2 or shape[0] != length or time_axis != 0:
            raise UntraceableError(f"a result of shape {shape}")
        return CompiledBlock(e, nodes[0].tolist(), *leaves, arranged)

    def at_samples() -> Symbol:
        return state_symbol(trace, samples, width)

    rates = system.rate(theta, changes, _at_stations(system, meaning, parameters))(state_symbol(trace, stations, width))
    at_ends, in_the_middle = _arrangements(system.grid)
    acting = _at_samples(system, meaning, parameters)
    jump = system.jump(theta, changes, acting)
    new = None if jump is None else block(jump.measured - jump.predict(at_samples()), samples, _as_is)
    try:
        outputs = block(system.outputs_by_states(theta, changes, at_samples(), acting), samples, _as_is)
    except Exception:  # a function may raise anything on a symbol; torch computes it instead, or raises again
        outputs = None
    return Traced(
        memories,
        CompiledBlock(e, as_nodes(begin, trace).nodes.reshape(-1).tolist(), *leaves, _as_is),
        block(rates, stations, at_ends),
        block(rates, stations, in_the_middle),
        new,
        outputs,
        () if jump is None else jump.places,
    )


def _at_stations(system: Traceable, meaning: Meaning, parameters: Symbol) -> Acting:
    """The inputs and the parameters at the stations."""
    inputs = _inputs(system, meaning, parameters)
    try:
        return Acting(inputs, system.acting_parameters(*meaning(parameters)))
    except Exception:  # a function may raise anything on a symbol; torch computes it instead, or raises again
        return Acting(
            inputs, _courses(system, meaning, parameters, system.acting_parameters, len(system.grid.stations))
        )


def _at_samples(system: Traceable, meaning: Meaning, parameters: Symbol) -> Acting:
    """The inputs and the parameters at the samples; those that change are picked from the stations by torch."""
    length, inputs = len(system.measured), _inputs_at_samples(system, meaning, parameters)
    return Acting(inputs, _courses(system, meaning, parameters, system.parameters_at_samples, length))


def _courses(
    system: Traceable, meaning: Meaning, parameters: Symbol, of: Callable[[Tensor, Changes], Names], length: int
) -> Names:
    """The parameters, those that an effect changes as columns computed by torch."""
    theta, changes = meaning(parameters)
    known = vars(system.parameters_of(theta))
    names = [name for name in known if f"parameter {name}" in changes]
    if not names:
        return Names(**known)

    def columns(values: Tensor) -> Tensor:
        found = of(*meaning(values))
        return torch.stack([getattr(found, name) for name in names], -1)

    symbol = course_symbol(columns, parameters, length, len(names))
    return Names(**{**known, **dict(zip(names, symbol.unbind(-1), strict=True))})


def _inputs(system: Traceable, meaning: Meaning, parameters: Symbol) -> Tensor:
    """The acting inputs at the stations; computed by torch where they cannot be traced, as behind a delay."""
    try:
        return system.acting_inputs(*meaning(parameters))
    except Exception:  # a function may raise anything on a symbol; torch computes it instead, or raises again
        stations, width = len(system.grid.stations), system.inputs.shape[1]
        return course_symbol(lambda values: system.acting_inputs(*meaning(values)), parameters, stations, width)


def _inputs_at_samples(system: Traceable, meaning: Meaning, parameters: Symbol) -> Tensor:
    """The inputs that the outputs depend on; computed by torch where they are picked from the stations."""
    theta, changes = meaning(parameters)
    if not system.acts_on_outputs(changes):
        return system.inputs_at_samples(theta, changes)
    samples, width = len(system.measured), system.inputs.shape[1]
    return course_symbol(lambda values: system.inputs_at_samples(*meaning(values)), parameters, samples, width)


def _as_is(column: Array) -> Array:
    return column


def _arrangements(grid: Grid) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
    """Functions that rearrange values at the stations to the ends and the middle of the intervals."""
    return (_at_ends, _in_the_middle) if grid.map_step is None else (_at_left_ends, _as_is)


def _at_ends(column: Array) -> Array:
    """Rearrange values at the stations to the ends of the intervals, (2, G-1)."""
    return np.ascontiguousarray(column.reshape(-1, 3)[:, ::2].T)


def _at_left_ends(column: Array) -> Array:
    return column[None]


def _in_the_middle(column: Array) -> Array:
    return np.ascontiguousarray(column.reshape(-1, 3)[:, 1])
