"""Sensor noise and process noise together: the size of the drawn disturbance, and whitening of residuals."""

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
"""RMS residual that a disturbance causes in the fitted open-loop run, over the sensor's noise."""

_ROUNDS = 12


@dataclass(frozen=True)
class DisturbedState:
    """Process noise of one state, in its true size.

    Attributes:
        kind: name of the scenario with such disturbances.
        state: the disturbed state.
        size: standard deviation in ``unit``; for white noise the square root of its spectral density.
        over_noise: RMS residual of the fitted open-loop run over the sensor's noise, largest of all outputs.
        free_over_noise: the same with the true parameters and initial states.
        words: times in s, by name.
        rates: added rates (n, F - 1, R).
        covariance: covariance of its means over the intervals between samples, for each run (R, T - 1, T - 1).
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


def draw_disturbance(g: Generator, kind: str, scene: SystemScene, errors: Errors) -> DisturbedState:
    """Draw a disturbance of a kind, its state, and its size relative to the sensors' noise."""
    plant = scene.plant
    state = choose(g, [name for name in plant.states if name not in plant.speeds])
    disturbance = KINDS[kind](g, scene.trial, plant.fine)
    wanted, rates = log_uniform(g, *OVER_NOISE), disturbance.at(plant, state)
    basis = range_of(tangents(scene, errors, rivals=False).known)
    size, free, left = _sized(
        _first_size(scene, state, disturbance), wanted, lambda k: _over_noise(scene, errors, k * rates, basis)
    )
    unit = per_second(plant.units[state]) + ("·√s" if kind == "pushed_white" else "")
    return DisturbedState(
        kind, state, size, unit, left, free, disturbance.words, size * rates, size**2 * disturbance.covariance
    )


def per_second(unit: str) -> str:
    """Return the unit of a rate.

    Example:
        >>> per_second("m"), per_second("rad/s")
        ('m/s', 'rad/s²')
    """
    return f"{unit}²" if unit.endswith("/s") else f"{unit}/s"


def _sized(size: float, wanted: float, seen: Callable[[float], tuple[float, float]]) -> tuple[float, float, float]:
    """Return the size that causes a residual of ``wanted``, its open-loop effect, and the residual that it causes."""
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


def _first_size(scene: SystemScene, state: str, disturbance: DisturbanceShape) -> float:
    """Return a small size: 1/1000 of the RMS rate of the state, or of the state over a run."""
    pace = max(scene.pace(state), scene.largest(state) / scene.length)
    return 1e-3 * pace / float(np.sqrt(np.square(disturbance.fine).mean()))


def _over_noise(scene: SystemScene, errors: Errors, rates: Array, basis: Array) -> tuple[float, float]:
    """Return the open-loop effect of a disturbance and its residual after a fit, largest of all outputs."""
    moved = simulate(scene.plant, scene.trial, disturbance=rates).outputs - scene.course.outputs
    white = errors.whitened(moved)
    left = white - basis @ (basis.T @ white)
    return _largest(white, len(moved)), _largest(left, len(moved))


def _largest(values: Array, outputs: int) -> float:
    return float(np.sqrt(np.square(values.reshape(outputs, -1)).mean(1)).max())


@dataclass(frozen=True)
class DisturbedErrors:
    """Errors of the outputs including process noise, to first order about the trajectory of a scene."""

    scene: SystemScene
    errors: Errors
    disturbed: DisturbedState

    def whitened(self, traces: Array) -> Array:
        """Whiten traces (m, T, R, q) to columns (M, q), or (m, T, R) to (M,), in standard deviations."""
        return np.asarray(np.linalg.solve(self._lower, self.errors.whitened(traces)), dtype=np.float64)

    @cached_property
    def _lower(self) -> Array:
        """Return the Cholesky factor (M, M) of the covariance, in standard deviations of the sensors' errors."""
        moved = responses(self.scene, self.disturbed.state)
        total = np.eye(moved[..., 0].size)
        for run in range(self.scene.trial.runs):
            only = np.zeros_like(moved)
            only[:, :, run] = moved[:, :, run]
            columns = self.errors.whitened(only)
            total += columns @ self.disturbed.covariance[run] @ columns.T
        return np.asarray(np.linalg.cholesky(total), dtype=np.float64)


def responses(scene: SystemScene, state: str) -> Array:
    """Return the first-order response of the outputs (m, T, R, T - 1) to a unit rate in each sampling interval."""
    plant, trial, x, u = scene.plant, scene.trial, scene.course.states, scene.course.inputs
    intervals, moments = trial.samples - 1, x.shape[1]
    forcing = np.zeros((moments, trial.runs, len(plant.states), intervals))
    for k in range(intervals):
        forcing[k * plant.fine : (k + 1) * plant.fine, :, plant.row(state), k] = 1.0
        # the integration weight at the ends of an interval is shared with its neighbours
        for end in (k * plant.fine, (k + 1) * plant.fine):
            if 0 < end < moments - 1:
                forcing[end, :, plant.row(state), k] = 0.5
    begin = np.zeros((trial.runs, len(plant.states), intervals))
    jacobian = jacobian_by_states(plant, x, u).transpose(2, 3, 0, 1)
    moved = variation(jacobian, forcing, begin, trial.step / plant.fine)[:: plant.fine // 2]
    return moved.transpose(2, 0, 1, 3)[[plant.row(name) for name in plant.outputs]]
