"""How much of the outputs' variation a right or wrong simulation can explain: the best of several fits, by own code."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from torch import Generator

from examples.blind_proof.draws import normal
from examples.blind_proof.equations.integrate import between
from examples.blind_proof.equations.plant import Array, Plant, Rate, RunSet
from examples.blind_proof.equations.simulations import WRONG_SIGN, class_of, parameters_of, right_source, wrong_source

_TRIED = 8
"""Number of starts, which are fitted in parallel."""

_ROUNDS = 25
_PARTS = 2
"""Integration steps between two samples."""

_AWAY = 1e3
"""Limit of the residual of a diverging run, in standard deviations of an output."""


@dataclass(frozen=True)
class Guess:
    """A simulation with the user's starting values and bounds of the parameters."""

    plant: Plant
    starts: Sequence[float]
    bounds: Sequence[tuple[float, float]]


WRONG_SIGNS: Mapping[str, tuple[float, ...]] = MappingProxyType(
    {
        "pendulum": (-1.0, 1.0, 1.0),
        "tanks": (1.0, 1.0, -1.0, -1.0),
        "motor": (1.0, 1.0, 1.0, -1.0, 1.0),
        "thermal": (-1.0, -1.0, 1.0, 1.0, 1.0),
    }
)
"""Signs of the parameters that give a simulation of the wrong sign."""


def right(plant: Plant) -> Guess:
    """Return the nominal simulation."""
    return Guess(plant, *parameters_of(right_source(class_of(plant.name))))


def wrong(plant: Plant, kind: str) -> Guess:
    """Return a simulation with a wrong sign, or of another system, with the columns of the recording."""
    starts, bounds = parameters_of(wrong_source(class_of(plant.name), kind))
    if kind == WRONG_SIGN:
        return Guess(replace(plant, rate=_wrong_sign(plant)), starts, bounds)
    if plant.name in ("tanks", "thermal"):
        crossed = replace(plant, rate=lambda x, u, p: plant.rate(x, u[::-1], p))
        return Guess(crossed, starts, bounds)
    if plant.name == "projectile":
        return Guess(replace(plant, rate=_puck), starts, bounds)
    return Guess(replace(plant, states=plant.outputs, rate=_lags), starts, bounds)


def _wrong_sign(plant: Plant) -> Rate:
    """Return the rate with the main term, or gravity, of the wrong sign."""

    def rate(x: Array, u: Array, p: Array) -> Array:
        if plant.name == "projectile":
            return plant.rate(x, u, p) * _along((1.0, 1.0, 1.0, -1.0), x)
        if plant.name == "cart_pole":  # gravity is the term that is odd in the angle
            return plant.rate(x * _along((1.0, 1.0, -1.0, 1.0), x), u, p)
        return plant.rate(x, u, p * _along(WRONG_SIGNS[plant.name], p))

    return rate


def _along(signs: Sequence[float], values: Array) -> Array:
    """Return the signs along the first axis of values."""
    return np.reshape(signs, (-1, *[1] * (values.ndim - 1)))


def _lags(x: Array, u: Array, p: Array) -> Array:
    """Each output is a first-order lag of the input."""
    return np.array([p[k] * u[0] - p[k + len(x)] * x[k] for k in range(len(x))])


def _puck(x: Array, u: Array, p: Array) -> Array:
    return np.array([x[2], x[3], -p[0] * x[2], -p[0] * x[3]])


def best_shares(g: Generator, guess: Guess, trial: RunSet, outputs: Array) -> list[float]:
    """Return the share of each output's variation (m, T, R) that the best joint fit explains.

    Levenberg-Marquardt over parameters and initial states. A share is below 0 if the mean explains more.
    """
    plant, runs = guess.plant, trial.runs
    middle = outputs.mean((1, 2), keepdims=True)
    scale = outputs.std((1, 2), keepdims=True)
    low, high = (np.array([bound[k] for bound in guess.bounds], dtype=float) for k in (0, 1))
    begin, reach = _first_states(plant, trial, outputs)
    theta = np.stack([np.concatenate([start, begin.ravel()]) for start in _starts(g, guess, low, high)])
    spread = np.concatenate([np.abs(theta[:, : len(low)]).max(0), np.repeat(reach, runs)])

    def left(points: Array) -> Array:
        """Return residuals (points, M) in standard deviations of the outputs."""
        states = _course(plant, trial, points[:, : len(low)], points[:, len(low) :])
        away = (states - outputs[:, :, None]) / scale[:, :, None]
        away = np.clip(np.nan_to_num(away, nan=_AWAY, posinf=_AWAY, neginf=-_AWAY), -_AWAY, _AWAY)
        return away.transpose(2, 0, 1, 3).reshape(len(points), -1)

    best, cost, damping = theta, np.full(len(theta), np.inf), np.full(len(theta), 1e-2)
    slopes, rest = np.zeros(()), np.zeros(())
    for _ in range(_ROUNDS):
        here, changes = _with_slopes(left, theta, 1e-5 * spread, high)
        now = np.square(here).mean(1)
        if slopes.ndim == 0:
            slopes, rest = changes, here
        better = now < cost
        best, cost = np.where(better[:, None], theta, best), np.where(better, now, cost)
        slopes, rest = np.where(better[:, None, None], changes, slopes), np.where(better[:, None], here, rest)
        damping = np.clip(np.where(better, 0.3 * damping, 5.0 * damping), 1e-9, 1e9)
        theta = best + _steps(slopes * spread, rest, damping) * spread
        theta[:, : len(low)] = np.clip(theta[:, : len(low)], low, high)
    k = int(cost.argmin())
    explained = 1.0 - np.square(left(best[[k]])[0].reshape(len(outputs), -1)).mean(1)
    total = np.square((outputs - middle) / scale).mean((1, 2))
    shares: list[float] = (1.0 - (1.0 - explained) / total).tolist()
    return shares


def _starts(g: Generator, guess: Guess, low: Array, high: Array) -> list[Array]:
    """Return the user's starts and others: up to ten times off, of either sign if allowed, every second small."""
    own = np.array(guess.starts, dtype=float)
    found = [own]
    for k in range(_TRIED - 1):
        other = own * np.exp(1.2 * normal(g, len(own)).numpy()) * (0.03 if k % 2 else 1.0)
        sign = np.where(np.isfinite(low) | (normal(g, len(own)).numpy() > 0.0), 1.0, -1.0)
        found.append(np.clip(sign * other, low, high))
    return found


def _first_states(plant: Plant, trial: RunSet, outputs: Array) -> tuple[Array, Array]:
    """Return initial states (n, R) and the range of each state (n,), from its output or that of its position.

    Speeds are first differences. A state that is not measured starts at 0 and has the range 1.
    """
    begin, reach = np.zeros((len(plant.states), trial.runs)), np.ones(len(plant.states))
    for output, values in zip(plant.outputs, outputs, strict=True):
        begin[plant.row(output)], reach[plant.row(output)] = values[0], np.ptp(values)
        if plant.speeds.get(output) in plant.states:
            row, pace = plant.row(plant.speeds[output]), np.diff(values, axis=0) / trial.step
            begin[row], reach[row] = pace[0], np.abs(pace).max()
    return begin, reach


def _course(plant: Plant, trial: RunSet, parameters: Array, begin: Array) -> Array:
    """Return outputs (m, T, K, R) for K parameters (K, p) and initial states (K, n R)."""
    count, runs = len(parameters), trial.runs
    sent = np.repeat(between(trial.inputs, 2 * _PARTS)[:, :, None], count, 2)
    p = np.repeat(parameters.T[:, :, None], runs, 2)
    x = begin.reshape(count, len(plant.states), runs).transpose(1, 0, 2)
    h, path = trial.step / _PARTS, [x]
    with np.errstate(all="ignore"):
        for k in range((trial.samples - 1) * _PARTS):
            a, b, c = sent[:, 2 * k], sent[:, 2 * k + 1], sent[:, 2 * k + 2]
            k1 = plant.rate(x, a, p)
            k2 = plant.rate(x + 0.5 * h * k1, b, p)
            k3 = plant.rate(x + 0.5 * h * k2, b, p)
            x = x + h / 6.0 * (k1 + 2.0 * (k2 + k3) + plant.rate(x + h * k3, c, p))
            if (k + 1) % _PARTS == 0:
                path.append(x)
    return np.stack(path, 1)[[plant.row(name) for name in plant.outputs]]


def _with_slopes(left: Callable[[Array], Array], theta: Array, step: Array, high: Array) -> tuple[Array, Array]:
    """Return residuals (S, M) and finite-difference derivatives (S, M, q) at S points (S, q)."""
    count, q = theta.shape
    steps = np.broadcast_to(step, theta.shape).copy()
    steps[:, : len(high)] *= np.where(theta[:, : len(high)] + steps[:, : len(high)] > high, -1.0, 1.0)
    moved = np.repeat(theta[:, None], q + 1, 1)
    moved[:, 1:] += steps[:, :, None] * np.eye(q)
    found = left(moved.reshape(-1, q)).reshape(count, q + 1, -1)
    changes = (found[:, 1:] - found[:, :1]) / steps[:, :, None]
    return found[:, 0], changes.transpose(0, 2, 1)


def _steps(slopes: Array, rest: Array, damping: Array) -> Array:
    """Return the step of each point (S, q), each with its own damping."""
    normal_matrix = np.einsum("smp,smq->spq", slopes, slopes)
    size = normal_matrix.diagonal(axis1=1, axis2=2).max(1)
    slope = np.einsum("smp,sm->sp", slopes, rest)
    own = normal_matrix.diagonal(axis1=1, axis2=2) + 1e-9 * size[:, None] + 1e-300
    damped = normal_matrix + (damping[:, None] * own)[:, :, None] * np.eye(slopes.shape[2])
    return -np.linalg.solve(damped, slope[..., None])[..., 0]
