"""Newton's method of :mod:`mkc_torch.simulation.dynamics.compiled.collocation`, on equations as programs."""

from __future__ import annotations

from typing import Any

import numpy as np

from mkc_torch.simulation.dynamics.loops.equations import defects, linearise_about
from mkc_torch.simulation.dynamics.loops.programs import jitable
from mkc_torch.simulation.dynamics.settings import HALVINGS, MOST_STEPS, QUICK, ROUGHLY, ROUNDING, SETTLED, STALLED


@jitable
def _scale_of(states: Any, scale: Any) -> None:
    w, G = states.shape
    largest = 0.0
    for j in range(w):
        most = 0.0
        for k in range(G):
            size = abs(states[j, k])
            if not size <= most:
                most = size
                if most != most:
                    break
        scale[j] = most
        if not most <= largest:
            largest = most
    for j in range(w):
        scale[j] = scale[j] + 1e-6 * largest + 1e-12


@jitable
def _norm(defect: Any, scale: Any) -> float:
    """Mean square of the scaled defects."""
    total = 0.0
    for j in range(len(defect)):
        for k in range(defect.shape[1]):
            ratio = defect[j, k] / scale[j]
            total += ratio * ratio
    return total / defect.size


@jitable
def _largest(change: Any, scale: Any) -> float:
    """Largest scaled change; NaN if there is one."""
    most = 0.0
    for j in range(len(change)):
        for k in range(change.shape[1]):
            size = abs(change[j, k]) / scale[j]
            if not size <= most:
                most = size
                if most != most:
                    return most
    return most


@jitable
def _change(carries: Any, inverse: Any, defect: Any, change: Any) -> None:
    """Change of the states, (w, G), that cancels the defects at fixed initial states."""
    w, L = defect.shape
    for i in range(w):
        change[i, 0] = 0.0
    for k in range(L):
        for i in range(w):
            total = 0.0
            for j in range(w):
                total += carries[i, j, k + 1] * change[j, k] - inverse[i, j, k] * defect[j, k]
            change[i, k + 1] = total


def solve_equations(equations: Any, jump: Any, h: Any, states: Any, carries: Any, inverse: Any, fresh: bool) -> bool:
    """Newton's method from a guess, as in :func:`..compiled.collocation.solved`; returns whether it converged.

    Args:
        equations, jump: see :mod:`.equations`.
        h: (G-1,), lengths of the intervals.
        states: (w, G), the guess; the solution on return.
        carries, inverse: (w, w, G) and (w, w, G-1), linearised equations nearby; those of the last step on return.
        fresh: whether the equations have to be linearised at the guess.
    """
    w, G = states.shape
    at, trial, change = states.copy(), np.empty((w, G)), np.empty((w, G))
    after, after_trial = np.empty((w, G)), np.empty((w, G))
    middle, middle_trial = np.empty((w, G - 1)), np.empty((w, G - 1))
    defect, defect_trial = np.empty((w, G - 1)), np.empty((w, G - 1))
    scale, scale_trial = np.empty(w), np.empty(w)
    none = np.empty((0, 0, 0))
    _scale_of(at, scale)
    defects(equations, jump, h, at, after, middle, defect)
    norms = np.empty(MOST_STEPS + 1)
    norms[0], taken = _norm(defect, scale), 1
    norm = norms[0]
    if fresh:
        linearise_about(equations, jump, h, at, after, middle, carries, inverse, none, none)
    for _ in range(MOST_STEPS):
        _change(carries, inverse, defect, change)
        size = _largest(change, scale)
        if size < SETTLED:
            for j in range(w):
                for k in range(G):
                    states[j, k] = at[j, k] + change[j, k]
            return True
        part, moved, norm_trial = 1.0, False, norm
        if size < np.inf:
            for _ in range(HALVINGS if fresh else 1):
                for j in range(w):
                    for k in range(G):
                        trial[j, k] = at[j, k] + part * change[j, k]
                _scale_of(trial, scale_trial)
                defects(equations, jump, h, trial, after_trial, middle_trial, defect_trial)
                norm_trial, moved = _norm(defect_trial, scale_trial), True
                if norm_trial <= norm:
                    break
                part *= 0.5
        if not fresh and not norm_trial <= QUICK * norm:
            linearise_about(equations, jump, h, at, after, middle, carries, inverse, none, none)
            fresh = True
            continue
        if not moved or (not norm_trial < norm and size * part > ROUNDING):
            break
        at, trial = trial, at
        after, after_trial = after_trial, after
        middle, middle_trial = middle_trial, middle
        defect, defect_trial = defect_trial, defect
        scale, scale_trial = scale_trial, scale
        norm, fresh = norm_trial, False
        norms[taken] = norm
        taken += 1
        if taken > STALLED and norm > 0.5 * norms[taken - 1 - STALLED] and size * part > ROUNDING:
            break
    return False


def solve_roughly(equations: Any, jump: Any, h: Any, states: Any, inside: Any) -> tuple[bool, bool]:
    """Newton's method at the grid times ``inside``, as in :func:`..compiled.collocation.marched`.

    Args:
        equations, jump, h: as in :func:`solve_equations`.
        states: (w, G), the guess; the result on return.
        inside: (G,), the mask.

    Returns:
        Whether the states are finite, and whether they converged.
    """
    w, G = states.shape
    change, trial, after = np.empty((w, G)), np.empty((w, G)), np.empty((w, G))
    middle, defect, scale = np.empty((w, G - 1)), np.empty((w, G - 1)), np.empty(w)
    carries, inverse = np.empty((w, w, G)), np.empty((w, w, G - 1))
    none = np.empty((0, 0, 0))
    for _ in range(MOST_STEPS):
        _scale_of(states, scale)
        defects(equations, jump, h, states, after, middle, defect)
        linearise_about(equations, jump, h, states, after, middle, carries, inverse, none, none)
        for k in range(G - 1):
            if not inside[k + 1]:
                for j in range(w):
                    defect[j, k] = 0.0
        _change(carries, inverse, defect, change)
        for k in range(G):
            if not inside[k]:
                for j in range(w):
                    change[j, k] = 0.0
        size = _largest(change, scale)
        if not size < np.inf:
            return False, False
        part, norm = 1.0, _norm(defect, scale)
        for _ in range(HALVINGS):
            for j in range(w):
                for k in range(G):
                    trial[j, k] = states[j, k] + part * change[j, k]
            defects(equations, jump, h, trial, after, middle, defect)
            for k in range(G - 1):
                if not inside[k + 1]:
                    for j in range(w):
                        defect[j, k] = 0.0
            if _norm(defect, scale) <= norm:
                break
            part *= 0.5
        for j in range(w):
            for k in range(G):
                states[j, k] += part * change[j, k]
        if size * part < ROUGHLY:
            return True, True
    return True, False
