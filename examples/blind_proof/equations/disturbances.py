"""Process noise: an unrecorded disturbance of the rate of one state, its size, and whitening of residuals."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from types import MappingProxyType

import numpy as np
from torch import Generator

from examples.blind_proof.draws import choose, log_uniform, normal, uniform, whole
from examples.blind_proof.equations.errors import Errors
from examples.blind_proof.equations.integrate import SystemScene, simulate, variation
from examples.blind_proof.equations.oracle import jacobian_by_states, range_of, tangents
from examples.blind_proof.equations.plant import Array, Plant, RunSet

SLOW = (0.03, 0.15)
"""Correlation time of slow process noise, as a share of a run."""

LASTING = (0.3, 1.0)
"""Correlation time of a lasting disturbance, as a share of a run."""

GUSTS = (2, 5)
"""Number of gusts in a run."""

GUST = (0.04, 0.15)
"""Length of a gust, as a share of a run."""


@dataclass(frozen=True)
class DisturbanceShape:
    """A disturbance of size 1 in each run.

    Attributes:
        fine: value in each fine step (F - 1, R).
        covariance: covariance of its means over the intervals between samples, for each run (R, T - 1, T - 1).
        words: times in s, by name.
    """

    fine: Array
    covariance: Array
    words: Mapping[str, float]

    def at(self, plant: Plant, state: str) -> Array:
        """Return the rates (n, F - 1, R) that it adds to one state."""
        rates = np.zeros((len(plant.states), *self.fine.shape))
        rates[plant.row(state)] = self.fine
        return rates


def white(g: Generator, trial: RunSet, fine: int) -> DisturbanceShape:
    """Draw white noise of spectral density 1, in the rate's unit times √s; fine steps are independent."""
    intervals, runs = trial.samples - 1, trial.runs
    values = normal(g, intervals * fine, runs).numpy() / np.sqrt(trial.step / fine)
    covariance = np.broadcast_to(np.eye(intervals) / trial.step, (runs, intervals, intervals))
    return DisturbanceShape(values, covariance, {})


def slow(g: Generator, trial: RunSet, fine: int, lasting: tuple[float, float] = SLOW) -> DisturbanceShape:
    """Draw an Ornstein-Uhlenbeck process of variance 1, stationary from the start of each run and new in each.

    Args:
        g: generator of the draws.
        trial: the runs.
        fine: integration steps between two samples.
        lasting: range of the correlation time, as a share of a run.
    """
    intervals, runs = trial.samples - 1, trial.runs
    constant = log_uniform(g, *lasting) * intervals * trial.step
    keep = np.exp(-trial.step / fine / constant)
    values = normal(g, intervals * fine, runs).numpy()
    values[1:] *= np.sqrt(1.0 - keep**2)
    for k in range(1, len(values)):
        values[k] += keep * values[k - 1]
    moments = trial.step * np.arange(intervals)
    kernel = np.exp(-np.abs(moments[:, None] - moments) / constant)
    return DisturbanceShape(values, np.broadcast_to(kernel, (runs, *kernel.shape)), {"correlation time": constant})


def gusts(g: Generator, trial: RunSet, fine: int) -> DisturbanceShape:
    """Draw a few gusts of constant height and either sign in each run; the disturbance is 0 between them."""
    intervals, runs = trial.samples - 1, trial.runs
    values, covariance = np.zeros((intervals, runs)), np.zeros((runs, intervals, intervals))
    for run in range(runs):
        for _ in range(whole(g, *GUSTS)):
            length = max(round(uniform(g, *GUST) * intervals), 2)
            start = whole(g, 0, intervals - length)
            height = uniform(g, 0.5, 1.5) * (1.0 if uniform(g, 0.0, 1.0) < 0.5 else -1.0)
            # a later gust replaces an earlier one
            values[start : start + length, run] = height
            covariance[run, start : start + length] = covariance[run, :, start : start + length] = 0.0
            covariance[run, start : start + length, start : start + length] = 1.0
    return DisturbanceShape(np.repeat(values, fine, 0), covariance, {})


SHORT = ("pushed_white", "pushed_slowly", "gusts")
"""Scenarios whose disturbances also act in other scenarios, in every second recording with hidden physics."""

LASTING_ALONE, LASTING_RUNS = "lasting_push", "lasting_push_runs"
"""Scenarios with a disturbance about as long as a run, in one run and in four. It acts in all their recordings."""

_lasting = partial(slow, lasting=LASTING)

KINDS: Mapping[str, Callable[[Generator, RunSet, int], DisturbanceShape]] = MappingProxyType(
    {"pushed_white": white, "pushed_slowly": slow, "gusts": gusts, LASTING_ALONE: _lasting, LASTING_RUNS: _lasting}
)
"""Draws of disturbances, by scenario."""


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
