"""Power of the best possible test to detect a hidden effect in a system's outputs, and to separate it from its rivals.

``z² = (1 − ε) δᵀ M δ``. δ is the difference between the outputs with the effect and those of the best fit without it.
M is the inverse covariance of the errors, with the tangents of parameters and initial states projected out in its
metric. ε is the share of outliers. Projecting out a rival's columns, too, gives a smaller number. For ``z_sep``, the
residual of the effect's own textbook form, which differs from the true form, is subtracted from its square: the result
is twice the log-likelihood gain of the own form over the rival, in nats.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from torch import Generator, Tensor

from examples.blind_proof.draws import happens, log_uniform
from examples.blind_proof.equations.errors import OUTLIERS, Errors, Whitening
from examples.blind_proof.equations.integrate import SystemScene, outputs_of_sizes, simulate, variation
from examples.blind_proof.equations.plant import Array, HiddenTerm, Plant, RunSet
from examples.blind_proof.equations.rivals import SUPERSETS, RivalModel, readings, rival_forms
from examples.blind_proof.key import Key
from mkc_torch.recording.recording import Recording

_RANK = 1e-9
_FLAT = 1e-7
_CLEARLY = 9.0
"""Twice the log-likelihood gain that a form containing the own form needs to count as a rival, nats."""

_ROUNDS = 3
_KEPT = math.sqrt(1.0 - OUTLIERS)


@dataclass(frozen=True)
class RivalPower:
    """A rival form, and the number of standard errors by which the effect's own form is better."""

    effect: str
    at: tuple[str, ...]
    z_sep: float


@dataclass(frozen=True)
class EffectPower:
    """Detectability of an effect in standard errors: against no effect, and against the best of ``rivals``.

    The rivals are sorted, best first. ``missed`` is the residual of the effect's own form; for effects outside the
    catalogue, all of the effect. ``larger`` are better forms that contain the own form.
    """

    z: float
    z_sep: float
    missed: float
    rivals: tuple[RivalPower, ...]
    larger: tuple[RivalPower, ...] = ()


@dataclass(frozen=True)
class WhitenedTangents:
    """Whitened derivatives of the outputs by parameters and initial states (M, p + nR), and by each form (M, q)."""

    known: Array
    forms: Sequence[tuple[RivalModel, Array]]


def tangents(scene: SystemScene, errors: Whitening, *, rivals: bool) -> WhitenedTangents:
    """Compute the tangents along the trajectory of a scene by the variational equation.

    Args:
        scene: a plant and its trajectory.
        errors: whiten the outputs.
        rivals: whether to include the rival forms.
    """
    plant, trial, x, u = scene.plant, scene.trial, scene.course.states, scene.course.inputs
    if (reads := plant.reads) is not None:
        read = readings(scene) if rivals else []
        forms = [(form, errors.whitened(form.outputs)) for form in read if form.outputs is not None]
        columns = _differences(lambda parameters: reads(u, parameters), plant.values)
        return WhitenedTangents(errors.whitened(np.stack(columns, -1)[:, :: plant.fine]), forms)
    n, p, runs = len(plant.states), len(plant.parameters), trial.runs
    found = rival_forms(scene, _by_inputs(plant, x, u)) if rivals else []
    forced = [form.forcing for form in found if form.forcing is not None]
    blocks = [_by_parameters(plant, x, u), np.zeros((*x.shape, n)), *forced]
    forcing = np.concatenate(blocks, -1).transpose(1, 2, 0, 3)
    begin = np.zeros((runs, n, forcing.shape[-1]))
    begin[:, :, p : p + n] = np.eye(n)
    jacobian = jacobian_by_states(plant, x, u).transpose(2, 3, 0, 1)
    moved = variation(jacobian, forcing, begin, trial.step / plant.fine)[:: plant.fine // 2]
    traces = moved.transpose(2, 0, 1, 3)[[plant.row(name) for name in plant.outputs]]
    starts = np.einsum("mtrn,rs->mtrsn", traces[..., p : p + n], np.eye(runs))
    known = np.concatenate([traces[..., :p], starts.reshape(*traces.shape[:3], -1)], -1)
    forms, place = [], p + n
    for form in found:
        if form.outputs is not None:
            forms.append((form, errors.whitened(form.outputs)))
        elif form.forcing is not None:
            size = form.forcing.shape[-1]
            forms.append((form, errors.whitened(traces[..., place : place + size])))
            place += size
    return WhitenedTangents(errors.whitened(known), forms)


def jacobian_by_states(plant: Plant, x: Array, u: Array) -> Array:
    """Return the Jacobian (n, n, F, R) of the rates."""
    return np.stack(_differences(lambda states: plant.rate(states, u, plant.values), x), 1)


def _by_inputs(plant: Plant, x: Array, u: Array) -> Array:
    """Return the derivatives of the rates by the inputs (n, k, F, R)."""
    columns = _differences(lambda inputs: plant.rate(x, inputs, plant.values), u)
    return np.stack(columns, 1) if columns else np.zeros((len(x), *u.shape))


def _by_parameters(plant: Plant, x: Array, u: Array) -> Array:
    """Return the derivatives of the rates by the parameters (n, F, R, p)."""
    columns = _differences(lambda parameters: plant.rate(x, u, parameters), plant.values)
    return np.stack(columns, -1) if columns else np.zeros((*x.shape, 0))


def _differences(function: Callable[[Array], Array], at: Array) -> list[Array]:
    """Return the derivative of a function by each row of its argument, by central differences."""
    columns = []
    for k in range(len(at)):
        away = np.zeros_like(at)
        away[k] = step = 1e-6 * (np.abs(at[k]).max() + 1e-9)
        columns.append((function(at + away) - function(at - away)) / (2.0 * step))
    return columns


def power(plant: Plant, trial: RunSet, hidden: HiddenTerm, size: float, errors: Whitening) -> EffectPower:
    """Return the power for an effect of a size, about the best fit without it."""
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
    """Add a step to the parameters and initial states (p + nR,)."""
    p = len(plant.parameters)
    values = dict(zip(plant.parameters, (plant.values + step[:p]).tolist(), strict=True))
    begin = trial.begin + step[p:].reshape(trial.runs, -1).T
    return replace(plant, parameters=values), replace(trial, begin=begin)


class Judge:
    """Rival forms with the known parameters projected out, for comparison with a hidden effect."""

    def __init__(self, found: WhitenedTangents) -> None:
        self._basis = range_of(found.known)
        self._cones = [
            ((form.effect, form.at), Cone(self._projected(columns), positive=form.positive))
            for form, columns in found.forms
        ]

    def _projected(self, columns: Array) -> Array:
        return columns - self._basis @ (self._basis.T @ columns)

    def power(self, left: Array, hidden: HiddenTerm) -> EffectPower:
        """Return the power for an effect with this residual (M,)."""
        left = self._projected(left)
        total = float(left @ left)
        missed: dict[Named, float] = {}
        for key, cone in self._cones:
            missed[key] = min(missed.get(key, total), max(total - cone.explained(left), 0.0))
        own = min((value for key, value in missed.items() if _is_own(key, hidden)), default=0.0)
        rivals = [
            RivalPower(*key, _KEPT * math.sqrt(max(value - own, 0.0)))
            for key, value in missed.items()
            if not _is_own(key, hidden) and not _contains(key, hidden) and key[0] not in hidden.twins
        ]
        rivals.sort(key=lambda rival: rival.z_sep)
        larger = [RivalPower(*key, 0.0) for key in missed if _contains(key, hidden) and own - missed[key] > _CLEARLY]
        larger += [RivalPower(*key, 0.0) for key in missed if key[0] in hidden.twins]
        z = _KEPT * math.sqrt(total)
        return EffectPower(
            z, min([z, *(r.z_sep for r in rivals)]), _KEPT * math.sqrt(own), tuple(rivals), tuple(larger)
        )


Named = tuple[str, tuple[str, ...]]
"""Name of an effect with its ports."""


def names(scene: SystemScene) -> frozenset[Named]:
    """Return the forms that a diagnosis could report; dry friction, for example, needs reversing speeds."""
    if scene.plant.reads is not None:
        found = readings(scene)
    else:
        found = rival_forms(scene, _by_inputs(scene.plant, scene.course.states, scene.course.inputs))
    return frozenset((form.effect, form.at) for form in found)


def can_be_named(hidden: HiddenTerm, known: frozenset[Named]) -> bool:
    """Whether one of the names is the effect at one of its ports."""
    return any(_is_own(key, hidden) for key in known)


def _is_own(key: Named, hidden: HiddenTerm) -> bool:
    return key[0] == hidden.effect and bool(set(key[1]) & set(hidden.at))


def _contains(key: Named, hidden: HiddenTerm) -> bool:
    return key[0] in SUPERSETS.get(hidden.effect, ()) and bool(set(key[1]) & set(hidden.at))


class Cone:
    """The span of columns (M, q), with amplitudes of any sign or ≥ 0.

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
        """Return the squared length of ``left`` (M,) that the columns explain."""
        best = 0.0
        for columns, inverse in self._faces:
            amplitudes = inverse @ left
            if not self._positive or (amplitudes >= 0.0).all():
                fitted = columns @ amplitudes
                best = max(best, float(fitted @ fitted))
        return best


def least_squares(columns: Array, left: Array) -> Array:
    """Return the amplitudes (q,) of columns (M, q) that explain most of ``left`` (M,)."""
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    return np.linalg.lstsq(columns / size, left, rcond=_RANK)[0] / size


def range_of(columns: Array) -> Array:
    """Return an orthonormal basis (M, r) of columns of any size."""
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    u, s, _ = np.linalg.svd(columns / size, full_matrices=False)
    return u[:, s > _RANK * s[0]]


STRONG_SHARE = 0.7
"""Share of the effects of the catalogue whose size is drawn by z_sep; the others are drawn by z."""

STRONG_Z_SEP = (12.0, 70.0)
FREE_Z = (3.0, 60.0)
OUTSIDE_Z = (10.0, 60.0)
MOST_Z = 250.0

_TRIED = 12
_LEAST = 1e-3
"""Smallest size that is tried, as a share of the obvious size."""


def draw_size(g: Generator, hidden: HiddenTerm, scene: SystemScene, errors: Whitening, *, outside: bool) -> float:
    """Draw a size below ``hidden.large``.

    Args:
        hidden: the effect.
        scene: the runs without hidden effects.
        errors: noise of the outputs.
        outside: whether the effect is outside the catalogue and has no rivals.
    """
    strong = not outside and happens(g, STRONG_SHARE)
    wanted = log_uniform(g, *(OUTSIDE_Z if outside else STRONG_Z_SEP if strong else FREE_Z))
    judge = Judge(tangents(scene, errors, rivals=strong))
    sizes = hidden.large * np.geomspace(_LEAST, 1.0, _TRIED)
    before = 0.0
    for k, there in enumerate(outputs_of_sizes(scene.plant, scene.trial, hidden, sizes)):
        seen = judge.power(errors.whitened(there - scene.course.outputs), hidden)
        # ratio to the limits; 1 is at a limit
        share = max(seen.z / MOST_Z, (seen.z_sep if strong else seen.z) / wanted)
        if share >= 1.0:
            between = math.log(before) / math.log(before / share) if before > 0.0 else 1.0
            return float(sizes[max(k - 1, 0)] ** (1.0 - between) * sizes[k] ** between)
        before = share
    return hidden.large


def oracle_rms(
    plant: Plant, trial: RunSet, hidden: HiddenTerm, size: float, errors: Errors, left: Array, good: np.ndarray
) -> float:
    """Return the RMS residual of the true system on inliers, with its initial state estimated from them.

    Args:
        plant, trial, hidden, size: the truth.
        errors: noise of the outputs.
        left: measured minus true outputs (m, T, R).
        good: mask of inliers (m, T, R).

    Returns:
        In standard deviations of the outputs' errors.
    """
    scale = np.reshape(errors.deviations, (-1, 1, 1))
    reach = 1e-4 * (np.abs(trial.begin).max(1) + 1e-3)
    n, runs = trial.begin.shape
    # the truth, and a copy of all runs for each state with another initial value
    begin = np.tile(trial.begin, n + 1)
    for state in range(n):
        begin[state, runs * (state + 1) : runs * (state + 2)] += reach[state]
    copies = replace(trial, inputs=np.tile(trial.inputs, n + 1), begin=begin)
    truth, *moved = np.split(simulate(plant, copies, hidden, size).outputs, n + 1, -1)
    columns: list[Array] = []
    rest = (left / scale)[good]
    if not moved:  # a system without states has no initial state
        return float(np.sqrt(np.square(rest).mean()))
    for state, there in enumerate(moved):
        change = (there - truth) / scale / reach[state]
        columns += [np.where(np.arange(runs) == run, change, 0.0)[good] for run in range(runs)]
    tangent = np.stack(columns, -1)
    rest = rest - tangent @ least_squares(tangent, rest)
    return float(np.sqrt(np.square(rest).mean()))


def ratio_to_oracle(simulated: Mapping[str, Tensor], second: Recording, key: Key) -> float:
    """Return the RMS error of an open-loop run on inliers, relative to the oracle's.

    Args:
        simulated: outputs of the corrected simulation.
        second: the unseen recording.
        key: key of the case, with ``oracle_rms``, the noise, and the numbers of the outliers, output by output.

    Returns:
        The ratio; infinite if the run is not finite.
    """
    deviations: Mapping[str, float] = key.noise["deviation"]
    error = np.concatenate(
        [(simulated[name] - second[name]).double().numpy() / deviation for name, deviation in deviations.items()]
    )
    good = np.ones(len(error), dtype=bool)
    good[list(key.second_outliers)] = False
    rms = float(np.sqrt(np.square(error[good]).mean()))
    return rms / key.oracle_rms if math.isfinite(rms) else math.inf
