"""The residual of a traced system and its tangents, computed with NumPy."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.dual_constants import dual_constants
from mkc_torch.nonlinear import load_forward_mode
from mkc_torch.simulation.continuation import Meaning, ResidualTangents
from mkc_torch.simulation.dynamics.compiled.affine import multiplied
from mkc_torch.simulation.dynamics.compiled.affine_calls import with_affine_calls
from mkc_torch.simulation.dynamics.compiled.arrays import ArraySystem
from mkc_torch.simulation.dynamics.compiled.collocation import ArrayGrid, Collocation, Factor, ParameterSources, marched
from mkc_torch.simulation.dynamics.compiled.expressions import Array
from mkc_torch.simulation.dynamics.compiled.in_sequence import in_sequence
from mkc_torch.simulation.dynamics.compiled.machine import (
    MachineSteps,
    MachineSystem,
    machine_steps,
    machine_system,
)
from mkc_torch.simulation.dynamics.compiled.traced import Traceable, Traced, traced
from mkc_torch.simulation.dynamics.observer import CLIP
from mkc_torch.simulation.dynamics.rollout import plain_steps, rolls_out
from mkc_torch.simulation.dynamics.trajectory import Jump, Rate, Trajectory, linearised_later
from mkc_torch.simulation.ports import Answer, Changes, Nearby

if TYPE_CHECKING:
    from jaxtyping import Float


_KEPT = 8
"""Number of past trajectories by own steps that are kept: a fit, its score and its tangents ask for the same."""


def compiled_dynamics(system: Traceable, meaning: Meaning, size: int) -> CompiledDynamics | None:
    """Compile the residual of a prepared system; None where its functions cannot be traced.

    Args:
        system: the prepared system.
        meaning: maps the parameters to the simulation's own parameters and the changes at its ports.
        size: number of parameters.
    """
    found = traced(system, meaning, size)
    return None if found is None else CompiledDynamics(system, meaning, size, found)


class CompiledDynamics:
    """The residual of a traced system; values and tangents agree with torch to rounding."""

    def __init__(self, system: Traceable, meaning: Meaning, size: int, functions: Traced) -> None:
        self._system, self._meaning, self._size, self._traced = system, meaning, size, functions
        grid = system.grid
        self._grid = ArrayGrid(grid.step.numpy(), grid.begins.numpy(), grid.longest, grid.map_step is not None)
        self.steps = self._grid.maps
        self._rows = system.rows.numpy()
        self._places = self._grid.begins.cumsum() - 1
        missing = system.missing
        self._recorded = None if missing is None else missing.recorded.numpy().T[:, None]
        self._nearest = None if missing is None else missing.nearest.numpy().T[:, None]
        self._measured = np.ascontiguousarray(system.measured.numpy().T)
        self._trajectories: OrderedDict[tuple[float, ...], Array] = OrderedDict()

    def answer(self, parameters: Float[Tensor, " p"], near: Nearby | None = None) -> Answer:
        """Compute the residual; NaN where no trajectory is found from ``near`` nor from the first guess.

        If ``near`` is None, the guess is also improved over a growing horizon.
        """
        known = near if isinstance(near, Trajectory) else None
        with np.errstate(all="ignore"):
            found = self._stepped(parameters)
            found = self._solved(parameters, known) if found is None else found
            if found is None:
                return Answer(torch.full_like(self._system.measured, torch.nan))
            states, factor = found
            outputs = self._outputs(parameters, states[:, self._rows])
            residual = self._whitened((self._measured - outputs)[:, None])[:, 0]
        nearby = self._nearby(parameters, states, factor)
        return Answer(torch.from_numpy(np.ascontiguousarray(residual.T)), nearby)

    def _stepped(self, parameters: Tensor) -> tuple[Array, Factor | None] | None:
        """The states of a simulation that steps by its own steps; None where these are slow, or fail."""
        if not self._grid.maps:
            return None
        key = tuple(parameters.tolist())
        found = self._trajectories.pop(key, None)
        found = self._by_own_steps(parameters) if found is None else found
        if found is None:
            return None
        self._trajectories[key] = found
        while len(self._trajectories) > _KEPT:
            self._trajectories.popitem(last=False)
        return found, None

    def _by_own_steps(self, parameters: Tensor) -> Array | None:
        theta, changes = self._meaning(parameters)
        steps, values = self._system.system.steps, parameters.tolist()
        if self._steps is not None:
            return self._steps.states(values, self._first(values))
        if steps is not None and steps.alone and rolls_out(self._system, theta, changes):
            return self._plain_steps(theta, changes)
        return in_sequence(self._traced, self._grid, values, self._first(values), self._rows, self._observed)

    def affine(self, parameters: Float[Tensor, " p"], near: Nearby) -> CompiledDynamics | None:
        """The residual with the simulation's own steps affine at a trajectory; None without steps, or where one fails.

        Near that trajectory it is the residual up to the curvature of the steps. Effects keep their own form.

        Args:
            parameters: of the trajectory.
            near: the trajectory, as an evaluation returned it.
        """
        if not self._grid.maps or not isinstance(near, Trajectory):
            return None
        states = self._guess_nearby(near, self._first(parameters.tolist()))[0][:, None, :-1]
        with np.errstate(all="ignore"):
            ends = with_affine_calls(self._traced.ends, parameters.tolist(), states)
        if ends is None:
            return None
        functions = replace(self._traced, ends=ends, middle=replace(ends, arranged=self._traced.middle.arranged))
        return CompiledDynamics(self._system, self._meaning, self._size, functions)

    def _solved(self, parameters: Tensor, known: Trajectory | None) -> tuple[Array, Factor | None] | None:
        """The states from a trajectory nearby or the first guess, and the linearised equations; None without any."""
        values = parameters.tolist()
        equations, first = self._collocation(values), self._first(values)
        found = None if known is None else equations.solved(*self._guess_nearby(known, first))
        # a fit of a simulation that steps shortens its own step where this fails
        if found is None and (known is None or not self._grid.maps):
            guess = self._with_first_states(self._system.guess, first)
            found = equations.solved(guess)
            nearer = self._nearer(parameters, equations, guess) if found is None and known is None else None
            found = found if nearer is None else equations.solved(nearer)
        return None if found is None else (found.states, found.factor)

    def _nearer(self, parameters: Tensor, equations: Collocation, guess: Array) -> Array | None:
        """A better guess, by plain steps or over a growing horizon; None where that fails."""
        if not self._grid.maps:
            return marched(equations, self._grid, guess)
        return self._plain_steps(*self._meaning(parameters))

    def _plain_steps(self, theta: Tensor, changes: Changes) -> Array | None:
        if self._system.observer is not None:
            return None
        found = plain_steps(self._system, theta, changes, self._system.first_states(theta, changes)[0])
        return None if found is None else np.ascontiguousarray(found.numpy().T)

    def marched(
        self, parameters: Float[Tensor, " p"], guess: Float[Tensor, "G w"], stride: int
    ) -> Float[Tensor, "G w"] | None:
        """Improve a guess by :func:`..collocation.marched`; None where that fails."""
        values = parameters.tolist()
        with np.errstate(all="ignore"):
            begun = self._with_first_states(guess, self._first(values))
            found = marched(self._collocation(values), self._grid, begun, stride)
        return None if found is None else torch.from_numpy(np.ascontiguousarray(found.T))

    def _guess_nearby(self, known: Trajectory, first: Array) -> tuple[Array, Factor | None]:
        """A trajectory nearby as the guess, and its linearised equations."""
        factor = None if known.linear is None else known.linear.factor
        usable = isinstance(factor, Factor) and known.states.shape[1] == self._traced.width
        return self._with_first_states(known.states, first), factor if usable and isinstance(factor, Factor) else None

    def _with_first_states(self, states: Tensor, first: Array) -> Array:
        """A guess (w, G) with these initial states (w, K)."""
        guess = self._system.with_memories(states.detach(), self._traced.memories)
        return np.where(self._grid.begins, first[:, self._places], guess.numpy().T)

    def tangents(self, parameters: Float[Tensor, " p"], near: Nearby | None) -> ResidualTangents | None:
        """Derivatives of the residual at a solved trajectory; None where the trajectory has other states."""
        if not isinstance(near, Trajectory) or near.states.shape[1] != self._traced.width:
            return None
        states, values = np.ascontiguousarray(near.states.detach().numpy().T), parameters.tolist()
        with np.errstate(all="ignore"):
            known = self._collocation(values).sources(states)
            rows = self._whitened(-self._output_tangents(parameters, states, known))
        tangents = torch.from_numpy(np.ascontiguousarray(np.moveaxis(rows, 0, -1)))
        return ResidualTangents(tangents, self._nearby(parameters, states, known.factor))

    def _outputs(self, parameters: Tensor, states: Array) -> Array:
        """The outputs, (m, N), from the states at the samples."""
        if self._traced.outputs is not None:
            return self._traced.outputs.values(parameters.tolist())(states)
        return self._outputs_by_torch(parameters, torch.from_numpy(np.ascontiguousarray(states.T))).numpy().T

    def _outputs_by_torch(self, parameters: Tensor, states: Tensor) -> Tensor:
        """The outputs, (N, m), from the states at the samples (N, w)."""
        return self._system.outputs_by_states(*self._meaning(parameters), states)

    def _output_tangents(self, parameters: Tensor, states: Array, known: ParameterSources) -> Array:
        """Derivatives of the outputs by all parameters, (m, p, N)."""
        values = parameters.tolist()
        moved, at = self._state_tangents(values, known), states[:, self._rows]
        outputs = self._traced.outputs
        if outputs is not None:
            rows = multiplied(outputs.by_states.at(values)(at), moved)
            rows[:, outputs.moving] += outputs.by_parameters.at(values)(at)
            return rows
        load_forward_mode()
        point = parameters, torch.from_numpy(np.ascontiguousarray(at.T))
        along = torch.eye(self._size, dtype=parameters.dtype), torch.from_numpy(np.ascontiguousarray(moved.T))

        def tangent(direction: Tensor, states: Tensor) -> Tensor:
            return torch.func.jvp(dual_constants(self._outputs_by_torch), point, (direction, states))[1]

        found = torch.func.vmap(tangent, in_dims=(0, 1))(*along)
        return np.ascontiguousarray(found.numpy().transpose(2, 0, 1))

    def _state_tangents(self, values: Sequence[float], known: ParameterSources) -> Array:
        """Derivatives of the states at the samples by all parameters, (w, p, N)."""
        w, K, G = known.source.shape
        source = np.zeros((w, K + w, G))
        source[:, :K] = known.source
        source[np.arange(w), K + np.arange(w)] = self._grid.begins
        moved = known.factor.affine.solved(source)[..., self._rows]
        rows = np.zeros((w, self._size, moved.shape[2]))
        rows[:, known.parameters] = moved[:, :K]
        by_first = moved[:, K:]
        first = self._traced.first
        slope = first.by_parameters.at(values)(np.empty(0)).reshape(-1, w, len(first.moving))
        for run, state, k in zip(*slope.nonzero(), strict=True):
            inside = self._runs[run]
            rows[:, first.moving[k], inside] += slope[run, state, k] * by_first[:, state, inside]
        return rows

    def _collocation(self, values: Sequence[float]) -> Collocation:
        return self._equations.at(values)

    @cached_property
    def _equations(self) -> MachineSystem | ArraySystem:
        parts = self._traced, self._grid, self._rows, self._observed
        return (None if self._grid.maps else machine_system(*parts)) or ArraySystem(*parts)

    @cached_property
    def _steps(self) -> MachineSteps | None:
        """The steps of a map without calls, as with affine ones."""
        known = self._traced, self._grid, self._rows, self._observed
        return machine_steps(*known) if self._grid.maps else None

    def _first(self, values: Sequence[float]) -> Array:
        """The initial states, (w, K)."""
        return self._traced.first.values(values)(np.empty(0)).reshape(-1, self._traced.width).T

    def _whitened(self, rows: Array) -> Array:
        """Whiten innovations to independent residuals of equal size, (m, K, N); missing ones have the nearest value."""
        rows = rows if self._recorded is None else np.where(self._recorded, rows, 0.0)
        white = rows if self._white is None else multiplied(self._white, rows)
        return white if self._nearest is None else np.take_along_axis(white, self._nearest, 2)

    def _nearby(self, parameters: Tensor, states: Array, factor: Factor | None) -> Trajectory:
        system, meaning = self._system, self._meaning
        found = torch.from_numpy(np.ascontiguousarray(states.T))

        def functions() -> tuple[Rate, Jump | None]:
            theta, changes = meaning(parameters)
            return system.rate(theta, changes), system.jump(theta, changes)

        return Trajectory(found, True, linearised_later(functions, found, system.grid, factor))

    @cached_property
    def _runs(self) -> list[slice]:
        """The samples of each run."""
        first = self._system.begins.nonzero()[:, 0].tolist()
        return [slice(a, b) for a, b in zip(first, [*first[1:], len(self._rows)], strict=True)]

    @cached_property
    def _observed(self) -> tuple[Array, Array] | None:
        """The observer's gain (k, m, N) and the clipping limit of the innovations (m, N)."""
        observer = self._system.observer
        if observer is None:
            return None
        gain = np.ascontiguousarray(np.moveaxis(observer.gain.numpy(), 0, -1))
        return gain, np.ascontiguousarray(CLIP * observer.spread.numpy().T)

    @cached_property
    def _white(self) -> Array | None:
        observer = self._system.observer
        return None if observer is None else np.ascontiguousarray(np.moveaxis(observer.white.numpy(), 0, -1))
