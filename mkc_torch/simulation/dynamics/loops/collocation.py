"""The collocation of :mod:`mkc_torch.simulation.dynamics.compiled.collocation`, with programs for the equations.

Functions share two tuples:

- equations: the programs of the rates and of their derivatives by the states, and the places of these derivatives;
- jump: an observer: the programs of the innovations and of their derivatives by the states, the places of these
  derivatives, the gain (k, m, N), the limit (m, N), the indices of the corrected states, and for each grid time the
  index of its sample, or -1. The index is empty without an observer.

Arrangements 0, 1 and 2 of the columns are the left end, the middle and the right end of an interval.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.extending import register_jitable

from mkc_torch.simulation.dynamics.loops.programs import BLOCK, loaded, registers, run
from mkc_torch.simulation.dynamics.settings import HALVINGS, MOST_STEPS, QUICK, ROUGHLY, ROUNDING, SETTLED, STALLED

__all__ = ["linearise_equations", "parameter_sources", "solve_equations", "solve_roughly"]

_LEFT, _MIDDLE, _RIGHT = 0, 1, 2


@register_jitable
def _innovations(jump: Any, states: Any, moved: Any, kept: Any, bent: Any) -> None:
    """Clipped innovations, the derivative of the clipping, and with ``bent`` of both by the states, (m, w, N)."""
    new, slopes, places, _, limit, _, sample = jump
    w, m = len(states), len(limit)
    at, rows = np.empty((w, BLOCK)), registers(new, w)
    by_states = registers(slopes, w)
    index = np.empty(BLOCK, np.int64)
    G, k, seen = states.shape[1], 0, 0
    while seen < limit.shape[1]:
        count = 0
        while k < G and count < BLOCK:
            if sample[k] >= 0:
                index[count] = k
                count += 1
            k += 1
        for j in range(w):
            for s in range(count):
                at[j, s] = states[j, index[s]]
        loaded(new, rows, at, 0, 0, seen, count)
        run(new, rows, count)
        for output in range(m):
            value = new[3][output]
            for s in range(count):
                most = limit[output, seen + s]
                share = np.tanh(rows[value, s] / most)
                moved[output, seen + s] = most * share
                kept[output, seen + s] = 1.0 - share * share
        if len(bent) > 0:
            loaded(slopes, by_states, at, 0, 0, seen, count)
            run(slopes, by_states, count)
            for e in range(len(places)):
                output, j, value = places[e, 0], places[e, 1], slopes[3][e]
                for s in range(count):
                    bent[output, j, seen + s] = kept[output, seen + s] * by_states[value, s]
        seen += count


@register_jitable
def _corrected(jump: Any, states: Any, after: Any) -> None:
    """States just after each grid time."""
    _, _, _, gain, limit, corrects, sample = jump
    for j in range(len(states)):
        for k in range(states.shape[1]):
            after[j, k] = states[j, k]
    if len(sample) == 0:
        return
    moved, kept = np.empty(limit.shape), np.empty(limit.shape)
    _innovations(jump, states, moved, kept, np.empty((0, 0, 0)))
    for k in range(len(sample)):
        s = sample[k]
        if s >= 0:
            for i in range(len(corrects)):
                total = 0.0
                for output in range(len(moved)):
                    total += gain[i, output, s] * moved[output, s]
                after[corrects[i], k] += total


@register_jitable
def _rates(rates: Any, rows: Any, states: Any, place: int, arrangement: int, first: int, count: int, out: Any) -> None:
    loaded(rates, rows, states, place, arrangement, first, count)
    run(rates, rows, count)
    for j in range(len(out)):
        value = rates[3][j]
        for k in range(count):
            out[j, k] = rows[value, k]


@register_jitable
def _defects(equations: Any, jump: Any, h: Any, states: Any, after: Any, middle: Any, defect: Any) -> None:
    """Defects of Simpson's rule, (w, G-1), with the states just after the grid times and in the middle."""
    rates = equations[0]
    w, L = defect.shape
    _corrected(jump, states, after)
    rows = registers(rates, w)
    left, right, inside = np.empty((w, BLOCK)), np.empty((w, BLOCK)), np.empty((w, BLOCK))
    for first in range(0, L, BLOCK):
        count = min(BLOCK, L - first)
        _rates(rates, rows, after, first, _LEFT, first, count, left)
        _rates(rates, rows, states, first + 1, _RIGHT, first, count, right)
        for j in range(w):
            for k in range(count):
                both = after[j, first + k] + states[j, first + k + 1]
                middle[j, first + k] = 0.5 * both + 0.125 * h[first + k] * (left[j, k] - right[j, k])
        _rates(rates, rows, middle, first, _MIDDLE, first, count, inside)
        for j in range(w):
            for k in range(count):
                step = h[first + k]
                gone = states[j, first + k + 1] - after[j, first + k] if step > 0.0 else 0.0
                defect[j, first + k] = gone - step / 6.0 * (left[j, k] + 4.0 * inside[j, k] + right[j, k])


@register_jitable
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


@register_jitable
def _norm(defect: Any, scale: Any) -> float:
    """Mean square of the scaled defects."""
    total = 0.0
    for j in range(len(defect)):
        for k in range(defect.shape[1]):
            ratio = defect[j, k] / scale[j]
            total += ratio * ratio
    return total / defect.size


@register_jitable
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


@register_jitable
def _invert(matrix: Any, inverse: Any) -> None:
    """Gauss-Jordan elimination with partial pivoting; NaN where singular. Overwrites the matrix."""
    n = len(matrix)
    if n == 1:
        inverse[0, 0] = 1.0 / matrix[0, 0]
        return
    if n == 2:
        determinant = matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
        inverse[0, 0], inverse[0, 1] = matrix[1, 1] / determinant, -matrix[0, 1] / determinant
        inverse[1, 0], inverse[1, 1] = -matrix[1, 0] / determinant, matrix[0, 0] / determinant
        return
    for i in range(n):
        for j in range(n):
            inverse[i, j] = 1.0 if i == j else 0.0
    for i in range(n):
        pivot = i
        for r in range(i + 1, n):
            if abs(matrix[r, i]) > abs(matrix[pivot, i]):
                pivot = r
        size = matrix[pivot, i]
        if not abs(size) > 0.0 or not abs(size) < np.inf:
            for r in range(n):
                for j in range(n):
                    inverse[r, j] = np.nan
            return
        for j in range(n):
            matrix[i, j], matrix[pivot, j] = matrix[pivot, j], matrix[i, j]
            inverse[i, j], inverse[pivot, j] = inverse[pivot, j], inverse[i, j]
        for j in range(n):
            matrix[i, j] /= size
            inverse[i, j] /= size
        for r in range(n):
            factor = matrix[r, i]
            if r != i and factor != 0.0:
                for j in range(n):
                    matrix[r, j] -= factor * matrix[i, j]
                    inverse[r, j] -= factor * inverse[i, j]


@register_jitable
def _slopes(slopes: Any, rows: Any, places: Any, states: Any, place: int, arrangement: int, first: int, count: int,
            out: Any) -> None:  # fmt: skip
    loaded(slopes, rows, states, place, arrangement, first, count)
    run(slopes, rows, count)
    for e in range(len(places)):
        i, j, value = places[e, 0], places[e, 1], slopes[3][e]
        for k in range(count):
            out[i, j, k] = rows[value, k]


@register_jitable
def _linearise(
    equations: Any, jump: Any, h: Any, states: Any, after: Any, middle: Any, carries: Any, inverse: Any, behind: Any,
    bend: Any,
) -> None:  # fmt: skip
    """Linearise about states; see :func:`linearise_equations`."""
    _, slopes, places = equations
    gain, limit, corrects, sample = jump[3], jump[4], jump[5], jump[6]
    w, L = middle.shape
    rows = registers(slopes, w)
    left, inside, right = np.zeros((w, w, BLOCK)), np.zeros((w, w, BLOCK)), np.zeros((w, w, BLOCK))
    backward, forward = np.empty((w, w, BLOCK)), np.empty((w, w, BLOCK))
    matrix, inverted, carry, row = np.empty((w, w)), np.empty((w, w)), np.empty((w, w)), np.empty(w)
    observed = len(sample) > 0
    bent = np.zeros((len(limit), w, limit.shape[1]))
    if observed:
        _innovations(jump, states, np.empty(limit.shape), np.empty(limit.shape), bent)
    for i in range(w):
        for j in range(w):
            carries[i, j, 0] = 0.0
    for first in range(0, L, BLOCK):
        count = min(BLOCK, L - first)
        _slopes(slopes, rows, places, after, first, _LEFT, first, count, left)
        _slopes(slopes, rows, places, middle, first, _MIDDLE, first, count, inside)
        _slopes(slopes, rows, places, states, first + 1, _RIGHT, first, count, right)
        for i in range(w):
            for j in range(w):
                for k in range(count):
                    backward[i, j, k] = left[i, j, k] + 2.0 * inside[i, j, k]
                    forward[i, j, k] = right[i, j, k] + 2.0 * inside[i, j, k]
                for q in range(w):
                    for k in range(count):
                        eighth = 0.5 * h[first + k] * inside[i, q, k]
                        backward[i, j, k] += eighth * left[q, j, k]
                        forward[i, j, k] -= eighth * right[q, j, k]
                own = 1.0 if i == j else 0.0
                for k in range(count):
                    sixth = h[first + k] / 6.0
                    backward[i, j, k] = -own - sixth * backward[i, j, k]
                    forward[i, j, k] = own - sixth * forward[i, j, k]
        if len(behind) > 0:
            for i in range(w):
                for j in range(w):
                    for k in range(count):
                        behind[i, j, first + k] = backward[i, j, k]
                        bend[i, j, first + k] = inside[i, j, k]
        for k in range(count):
            for i in range(w):
                for j in range(w):
                    matrix[i, j] = forward[i, j, k]
            _invert(matrix, inverted)
            for i in range(w):
                for j in range(w):
                    inverse[i, j, first + k] = inverted[i, j]
                    total = 0.0
                    if h[first + k] > 0.0:
                        for q in range(w):
                            total -= inverted[i, q] * backward[q, j, k]
                    carry[i, j] = total
            if observed and sample[first + k] >= 0:
                s = sample[first + k]
                for i in range(w):
                    for j in range(w):
                        row[j] = 0.0
                    for output in range(len(bent)):
                        total = 0.0
                        for q in range(len(corrects)):
                            total += carry[i, corrects[q]] * gain[q, output, s]
                        for j in range(w):
                            row[j] += total * bent[output, j, s]
                    for j in range(w):
                        carry[i, j] += row[j]
            for i in range(w):
                for j in range(w):
                    carries[i, j, first + k + 1] = carry[i, j]


@register_jitable
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
        equations, jump: see the module.
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
    _defects(equations, jump, h, at, after, middle, defect)
    norms = np.empty(MOST_STEPS + 1)
    norms[0], taken = _norm(defect, scale), 1
    norm = norms[0]
    if fresh:
        _linearise(equations, jump, h, at, after, middle, carries, inverse, none, none)
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
                _defects(equations, jump, h, trial, after_trial, middle_trial, defect_trial)
                norm_trial, moved = _norm(defect_trial, scale_trial), True
                if norm_trial <= norm:
                    break
                part *= 0.5
        if not fresh and not norm_trial <= QUICK * norm:
            _linearise(equations, jump, h, at, after, middle, carries, inverse, none, none)
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
        _defects(equations, jump, h, states, after, middle, defect)
        _linearise(equations, jump, h, states, after, middle, carries, inverse, none, none)
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
            _defects(equations, jump, h, trial, after, middle, defect)
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


def linearise_equations(
    equations: Any, jump: Any, h: Any, states: Any, carries: Any, inverse: Any, behind: Any, bend: Any, middle: Any,
    after: Any,
) -> None:  # fmt: skip
    """Linearise about states (w, G); writes into all arguments after them.

    Args:
        equations, jump, h, states: as in :func:`solve_equations`.
        carries, inverse: the linearised equations.
        behind: (w, w, G-1), derivative of the defects by the states just after the left ends.
        bend: (w, w, G-1), derivative of the rates by the states in the middle.
        middle, after: (w, G-1) and (w, G), states in the middle of the intervals and just after the grid times.
    """
    defect = np.empty(middle.shape)
    _defects(equations, jump, h, states, after, middle, defect)
    _linearise(equations, jump, h, states, after, middle, carries, inverse, behind, bend)


def parameter_sources(
    slopes: Any, places: Any, h: Any, states: Any, after: Any, middle: Any, bend: Any, inverse: Any, shift: Any,
    behind: Any, out: Any,
) -> None:  # fmt: skip
    """Write the sources of the states' derivatives by K parameters into ``out``, (w, K, G).

    Args:
        slopes, places: program of the rates' derivatives by the parameters, and their places (state, parameter).
        h, states, after, middle, bend, inverse, behind: as in :func:`linearise_equations`.
        shift: (w, K, G), derivatives of the states just after the grid times by the parameters; empty for none.
        out: 0 at the first grid time.
    """
    w, K = out.shape[0], out.shape[1]
    L = middle.shape[1]
    rows = registers(slopes, w)
    left, inside, right = np.zeros((w, K, BLOCK)), np.zeros((w, K, BLOCK)), np.zeros((w, K, BLOCK))
    defect = np.empty((w, BLOCK))
    for i in range(w):
        for p in range(K):
            out[i, p, 0] = 0.0
    for first in range(0, L, BLOCK):
        count = min(BLOCK, L - first)
        _slopes(slopes, rows, places, after, first, _LEFT, first, count, left)
        _slopes(slopes, rows, places, middle, first, _MIDDLE, first, count, inside)
        _slopes(slopes, rows, places, states, first + 1, _RIGHT, first, count, right)
        for p in range(K):
            for i in range(w):
                for k in range(count):
                    defect[i, k] = left[i, p, k] + 4.0 * inside[i, p, k] + right[i, p, k]
                for q in range(w):
                    for k in range(count):
                        moved = 0.125 * h[first + k] * (left[q, p, k] - right[q, p, k])
                        defect[i, k] += 4.0 * bend[i, q, first + k] * moved
                for k in range(count):
                    defect[i, k] = -h[first + k] / 6.0 * defect[i, k]
                if len(shift) > 0:
                    for q in range(w):
                        for k in range(count):
                            if h[first + k] > 0.0:
                                defect[i, k] += behind[i, q, first + k] * shift[q, p, first + k]
            for i in range(w):
                for k in range(count):
                    total = 0.0
                    for q in range(w):
                        total -= inverse[i, q, first + k] * defect[q, k]
                    out[i, p, first + k + 1] = total
