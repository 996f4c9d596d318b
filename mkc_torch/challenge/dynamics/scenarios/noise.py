"""Sensor noise and process noise together: how large a push is drawn, and how traces are weighed under it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from torch import Generator

from mkc_torch.challenge.draws import choose, log_uniform
from mkc_torch.challenge.dynamics.errors import Errors
from mkc_torch.challenge.dynamics.integrate import simulate, variation
from mkc_torch.challenge.dynamics.oracle import jacobian_by_states, range_of, tangents
from mkc_torch.challenge.dynamics.plant import Array
from mkc_torch.challenge.dynamics.scenarios.disturbances import KINDS, DisturbanceShape
from mkc_torch.challenge.dynamics.scene import SystemScene

OVER_NOISE = (2.0, 8.0)
"""What a push leaves in the fitted free run, root mean square, over the standard deviation of a sensor's errors."""

_ROUNDS = 12


@dataclass(frozen=True)
class DisturbedState:
    """A push of one state, of its true size.

    Attributes:
        kind: name of the world that has such pushes.
        state: whose rate is pushed.
        size: standard deviation of the push in ``unit``; of a white one the root of its spectral density.
        over_noise: what it leaves in the fitted free run over a sensor's errors, of the output where it is most.
        free_over_noise: the same with parameters and first states at their true values.
        words: times in s.
        rates: what is added to the rates (n, F - 1, R).
        covariance: of its means over the intervals between samples, for each run (R, T - 1, T - 1).
    """

    kind: str
    state: str
    size: float
    unit: str
    over_noise: float
    free_over_noise: float
    words: Mapping[str, float]
    rates: Array
    covariance: Array


def draw_push(g: Generator, kind: str, scene: SystemScene, errors: Errors) -> DisturbedState:
    """A push of that kind, of a state drawn, as large as the noise of the sensors asks for."""
    plant = scene.plant
    state = choose(g, [name for name in plant.states if name not in plant.speeds])
    push = KINDS[kind](g, scene.trial, plant.fine)
    wanted, rates = log_uniform(g, *OVER_NOISE), push.at(plant, state)
    basis = range_of(tangents(scene, errors, rivals=False).known)
    size, free, left = _sized(
        _first_size(scene, state, push), wanted, lambda k: _over_noise(scene, errors, k * rates, basis)
    )
    unit = per_second(plant.units[state]) + ("·√s" if kind == "pushed_white" else "")
    return DisturbedState(kind, state, size, unit, left, free, push.words, size * rates, size**2 * push.covariance)


def per_second(unit: str) -> str:
    """The unit of a rate.

    Example:
        >>> per_second("m"), per_second("rad/s")
        ('m/s', 'rad/s²')
    """
    return f"{unit}²" if unit.endswith("/s") else f"{unit}/s"


def _sized(size: float, wanted: float, seen: Callable[[float], tuple[float, float]]) -> tuple[float, float, float]:
    """A size of which ``wanted`` is left, with what it does free and what is left; nearly so where it goes by leaps."""
    low, high, best = 0.0, np.inf, (0.0, 0.0, 0.0)
    for _ in range(_ROUNDS):
        free, left = seen(size)
        if left <= 1.02 * wanted:
            low, best = size, (size, free, left)
            if left >= 0.98 * wanted:
                break
        else:
            high = size
        size *= wanted / left
        if not low < size < high:
            size = float(np.sqrt(low * high)) if low else 0.5 * high
    return best


def _first_size(scene: SystemScene, state: str, push: DisturbanceShape) -> float:
    """A size that moves nothing far: a thousandth of how fast the state goes by itself, or of itself in a run."""
    pace = max(scene.pace(state), scene.largest(state) / scene.length)
    return 1e-3 * pace / float(np.sqrt(np.square(push.fine).mean()))


def _over_noise(scene: SystemScene, errors: Errors, rates: Array, basis: Array) -> tuple[float, float]:
    """Of the output where it is most: what a push does to the free run, and what is left of that after a fit."""
    moved = simulate(scene.plant, scene.trial, push=rates).outputs - scene.course.outputs
    white = errors.whitened(moved)
    left = white - basis @ (basis.T @ white)
    return _largest(white, len(moved)), _largest(left, len(moved))


def _largest(values: Array, outputs: int) -> float:
    return float(np.sqrt(np.square(values.reshape(outputs, -1)).mean(1)).max())


@dataclass(frozen=True)
class DisturbedErrors:
    """The errors of the outputs beside a push, to first order about the course of a scene."""

    scene: SystemScene
    errors: Errors
    pushed: DisturbedState

    def whitened(self, traces: Array) -> Array:
        """Columns (M, q) of traces (m, T, R, q), or (M,) of (m, T, R), in standard deviations of independent errors."""
        return np.asarray(np.linalg.solve(self._lower, self.errors.whitened(traces)), dtype=np.float64)

    @cached_property
    def _lower(self) -> Array:
        """Cholesky's factor (M, M) of the covariance in standard deviations of the sensors' errors."""
        moved = responses(self.scene, self.pushed.state)
        total = np.eye(moved[..., 0].size)
        for run in range(self.scene.trial.runs):
            only = np.zeros_like(moved)
            only[:, :, run] = moved[:, :, run]
            columns = self.errors.whitened(only)
            total += columns @ self.pushed.covariance[run] @ columns.T
        return np.asarray(np.linalg.cholesky(total), dtype=np.float64)


def responses(scene: SystemScene, state: str) -> Array:
    """What a push of 1 in each interval between samples does to the outputs (m, T, R, T - 1), to first order."""
    plant, trial, x, u = scene.plant, scene.trial, scene.course.states, scene.course.inputs
    intervals, moments = trial.samples - 1, x.shape[1]
    forcing = np.zeros((moments, trial.runs, len(plant.states), intervals))
    for k in range(intervals):
        forcing[k * plant.fine : (k + 1) * plant.fine, :, plant.row(state), k] = 1.0
        # half of what the rule of integration gives the ends of an interval belongs to either side
        for end in (k * plant.fine, (k + 1) * plant.fine):
            if 0 < end < moments - 1:
                forcing[end, :, plant.row(state), k] = 0.5
    begin = np.zeros((trial.runs, len(plant.states), intervals))
    jacobian = jacobian_by_states(plant, x, u).transpose(2, 3, 0, 1)
    moved = variation(jacobian, forcing, begin, trial.step / plant.fine)[:: plant.fine // 2]
    return moved.transpose(2, 0, 1, 3)[[plant.row(name) for name in plant.outputs]]
