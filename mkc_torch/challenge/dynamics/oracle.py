"""How well the best possible test would see a hidden effect in a system's outputs, and tell it from its best rival.

``z² = (1 − ε) δᵀ M δ``: δ is how the outputs with the effect differ from those without it at the parameters and first
states that follow them best, M the inverse of the errors' covariance with the tangents by those projected out in its
metric, ε the share of outliers. Projecting a rival's columns out too leaves a smaller number; what the effect's own
textbook form leaves, which is not the true form, is taken off its square for ``z_sep``: twice the nats by which the own
form goes before the rival.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from mkc_torch.challenge.dynamics.errors import OUTLIERS, Whitening
from mkc_torch.challenge.dynamics.integrate import simulate, variation
from mkc_torch.challenge.dynamics.plant import Array, HiddenTerm, Plant, RunSet
from mkc_torch.challenge.dynamics.readings import readings
from mkc_torch.challenge.dynamics.rivals import SUPERSETS, RivalModel, accounts
from mkc_torch.challenge.dynamics.scene import SystemScene

_RANK = 1e-9
_FLAT = 1e-7
_CLEARLY = 9.0
"""Twice the nats by which an account that contains the own form has to go before it."""

_ROUNDS = 3
_KEPT = math.sqrt(1.0 - OUTLIERS)


@dataclass(frozen=True)
class RivalPower:
    """Another account, and by how many standard deviations the effect's own form goes before it."""

    effect: str
    at: tuple[str, ...]
    z_sep: float


@dataclass(frozen=True)
class EffectPower:
    """Numbers of standard deviations: against nothing, and against the best of ``rivals``, hardest first.

    ``missed`` is what the effect's own form leaves; of effects outside the catalogue, all of it. ``larger`` are
    accounts that contain the own form and go before it.
    """

    z: float
    z_sep: float
    missed: float
    rivals: tuple[RivalPower, ...]
    larger: tuple[RivalPower, ...] = ()


@dataclass(frozen=True)
class WhitenedTangents:
    """Whitened derivatives of the outputs: by parameters and first states (M, p + nR), and by each account (M, q)."""

    known: Array
    accounts: Sequence[tuple[RivalModel, Array]]


def tangents(scene: SystemScene, errors: Whitening, *, rivals: bool) -> WhitenedTangents:
    """Along the course of a scene, by the variational equation.

    Args:
        scene: a plant and its course.
        errors: by which outputs are weighed.
        rivals: all accounts too, or the known parameters alone.
    """
    plant, trial, x, u = scene.plant, scene.trial, scene.course.states, scene.course.inputs
    if plant.reads is not None:
        read = readings(scene) if rivals else []
        told = [(one, errors.whitened(one.outputs)) for one in read if one.outputs is not None]
        return WhitenedTangents(errors.whitened(_readings_by_parameters(plant, u)), told)
    n, p, runs = len(plant.states), len(plant.parameters), trial.runs
    found = accounts(scene, _by_inputs(plant, x, u)) if rivals else []
    forced = [account.forcing for account in found if account.forcing is not None]
    blocks = [_by_parameters(plant, x, u), np.zeros((*x.shape, n)), *forced]
    forcing = np.concatenate(blocks, -1).transpose(1, 2, 0, 3)
    begin = np.zeros((runs, n, forcing.shape[-1]))
    begin[:, :, p : p + n] = np.eye(n)
    jacobian = jacobian_by_states(plant, x, u).transpose(2, 3, 0, 1)
    moved = variation(jacobian, forcing, begin, trial.step / plant.fine)[:: plant.fine // 2]
    traces = moved.transpose(2, 0, 1, 3)[[plant.row(name) for name in plant.outputs]]
    starts = np.einsum("mtrn,rs->mtrsn", traces[..., p : p + n], np.eye(runs))
    known = np.concatenate([traces[..., :p], starts.reshape(*traces.shape[:3], -1)], -1)
    told, place = [], p + n
    for account in found:
        if account.outputs is not None:
            told.append((account, errors.whitened(account.outputs)))
        elif account.forcing is not None:
            size = account.forcing.shape[-1]
            told.append((account, errors.whitened(traces[..., place : place + size])))
            place += size
    return WhitenedTangents(errors.whitened(known), told)


def jacobian_by_states(plant: Plant, x: Array, u: Array) -> Array:
    """Jacobian (n, n, F, R) of the rates, by central differences."""
    p = plant.values
    scale = np.abs(x).max((1, 2)) + 1e-9
    columns = []
    for k in range(len(x)):
        away = np.zeros_like(x)
        away[k] = 1e-6 * scale[k]
        columns.append((plant.rate(x + away, u, p) - plant.rate(x - away, u, p)) / (2e-6 * scale[k]))
    return np.stack(columns, 1)


def _by_inputs(plant: Plant, x: Array, u: Array) -> Array:
    """(n, k, F, R), by central differences."""
    if not len(u):
        return np.zeros((len(x), *u.shape))
    columns = []
    for k in range(len(u)):
        away = np.zeros_like(u)
        away[k] = step = 1e-6 * (np.abs(u[k]).max() + 1e-9)
        columns.append((plant.rate(x, u + away, plant.values) - plant.rate(x, u - away, plant.values)) / (2.0 * step))
    return np.stack(columns, 1)


def _by_parameters(plant: Plant, x: Array, u: Array) -> Array:
    """(n, F, R, p), by central differences."""
    p = plant.values
    columns = []
    for k in range(len(p)):
        away = np.zeros_like(p)
        away[k] = 1e-6 * (abs(p[k]) + 1e-9)
        columns.append((plant.rate(x, u, p + away) - plant.rate(x, u, p - away)) / (2.0 * away[k]))
    return np.stack(columns, -1) if columns else np.zeros((*x.shape, 0))


def _readings_by_parameters(plant: Plant, u: Array) -> Array:
    """(m, T, R, p) of a system without states, by central differences."""
    assert plant.reads is not None
    p, columns = plant.values, []
    for k in range(len(p)):
        away = np.zeros_like(p)
        away[k] = 1e-6 * (abs(p[k]) + 1e-9)
        columns.append((plant.reads(u, p + away) - plant.reads(u, p - away)) / (2.0 * away[k]))
    return np.stack(columns, -1)[:, :: plant.fine]


def power(plant: Plant, trial: RunSet, hidden: HiddenTerm, size: float, errors: Whitening) -> EffectPower:
    """Of an effect at its size, about the parameters and first states that follow it best without it."""
    truth = simulate(plant, trial, hidden, size).outputs
    scene = SystemScene(plant, trial, simulate(plant, trial))
    best = scene, errors.whitened(truth - scene.course.outputs)
    for _ in range(_ROUNDS):
        step = least_squares(tangents(scene, errors, rivals=False).known, best[1])
        nearer = moved(scene.plant, scene.trial, step)
        scene = SystemScene(*nearer, simulate(*nearer))
        left = errors.whitened(truth - scene.course.outputs)
        if not np.isfinite(left).all() or np.square(left).sum() >= 0.999 * np.square(best[1]).sum():
            break
        best = scene, left
    return Judge(tangents(best[0], errors, rivals=True)).power(best[1], hidden)


def moved(plant: Plant, trial: RunSet, step: Array) -> tuple[Plant, RunSet]:
    """Parameters and first states (p + nR,) further by a step."""
    p = len(plant.parameters)
    values = dict(zip(plant.parameters, (plant.values + step[:p]).tolist(), strict=True))
    begin = trial.begin + step[p:].reshape(trial.runs, -1).T
    return replace(plant, parameters=values), replace(trial, begin=begin)


class Judge:
    """Accounts with the known parameters projected out, ready to be compared with whatever a hidden effect leaves."""

    def __init__(self, found: WhitenedTangents) -> None:
        self._basis = range_of(found.known)
        self._accounts = [
            ((account.effect, account.at), Cone(self._beside(columns), positive=account.positive))
            for account, columns in found.accounts
        ]

    def _beside(self, columns: Array) -> Array:
        return columns - self._basis @ (self._basis.T @ columns)

    def power(self, left: Array, hidden: HiddenTerm) -> EffectPower:
        """Of an effect that leaves so much (M,)."""
        left = self._beside(left)
        total = float(left @ left)
        missed: dict[Key, float] = {}
        for key, cone in self._accounts:
            missed[key] = min(missed.get(key, total), max(total - cone.explained(left), 0.0))
        own = min((value for key, value in missed.items() if _is_own(key, hidden)), default=0.0)
        told = [
            RivalPower(*key, _KEPT * math.sqrt(max(value - own, 0.0)))
            for key, value in missed.items()
            if not _is_own(key, hidden) and not _contains(key, hidden) and key[0] not in hidden.twins
        ]
        told.sort(key=lambda rival: rival.z_sep)
        larger = [RivalPower(*key, 0.0) for key in missed if _contains(key, hidden) and own - missed[key] > _CLEARLY]
        larger += [RivalPower(*key, 0.0) for key in missed if key[0] in hidden.twins]
        z = _KEPT * math.sqrt(total)
        return EffectPower(z, min([z, *(r.z_sep for r in told)]), _KEPT * math.sqrt(own), tuple(told), tuple(larger))


Key = tuple[str, tuple[str, ...]]
"""An effect and where it acts."""


def names(scene: SystemScene) -> frozenset[Key]:
    """All that a diagnosis could say: dry friction, say, it could not at speeds that never reverse."""
    if scene.plant.reads is not None:
        found = readings(scene)
    else:
        found = accounts(scene, _by_inputs(scene.plant, scene.course.states, scene.course.inputs))
    return frozenset((account.effect, account.at) for account in found)


def can_be_named(hidden: HiddenTerm, known: frozenset[Key]) -> bool:
    """Whether one of the names is that of the effect, at one of its places."""
    return any(_is_own(key, hidden) for key in known)


def _is_own(key: Key, hidden: HiddenTerm) -> bool:
    return key[0] == hidden.effect and bool(set(key[1]) & set(hidden.at))


def _contains(key: Key, hidden: HiddenTerm) -> bool:
    return key[0] in SUPERSETS.get(hidden.effect, ()) and bool(set(key[1]) & set(hidden.at))


class Cone:
    """What columns (M, q) can explain, with amplitudes of any sign or none below 0.

    Example:
        >>> column = np.array([[1.0], [0.0]])
        >>> [Cone(column, positive=sign).explained(np.array([-2.0, 1.0])) for sign in (True, False)]
        [0.0, 4.0]
    """

    def __init__(self, columns: Array, *, positive: bool) -> None:
        size = np.linalg.norm(columns, axis=0)
        kept = columns[:, size > 0.0] / size[size > 0.0]
        count = kept.shape[1]
        parts = [part for k in range(1, count + 1) for part in combinations(range(count), k)]
        self._positive = positive
        self._faces = [
            (kept[:, part], np.linalg.pinv(kept[:, part], rcond=_FLAT)) for part in (parts if positive else parts[-1:])
        ]

    def explained(self, left: Array) -> float:
        """Squared length that they take off ``left`` (M,)."""
        best = 0.0
        for columns, inverse in self._faces:
            amplitudes = inverse @ left
            if not self._positive or (amplitudes >= 0.0).all():
                fitted = columns @ amplitudes
                best = max(best, float(fitted @ fitted))
        return best


def least_squares(columns: Array, left: Array) -> Array:
    """The step (q,) along columns (M, q) that takes most off ``left`` (M,)."""
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    return np.linalg.lstsq(columns / size, left, rcond=_RANK)[0] / size


def range_of(columns: Array) -> Array:
    """An orthonormal basis (M, r) of columns of any size."""
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    u, s, _ = np.linalg.svd(columns / size, full_matrices=False)
    return u[:, s > _RANK * s[0]]
