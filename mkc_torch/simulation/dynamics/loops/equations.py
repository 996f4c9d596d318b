"""Collocation equations and their derivatives, with programs for the rates.

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

from mkc_torch.simulation.dynamics.loops.programs import BLOCK, jitable, loaded, registers, run

_LEFT, _MIDDLE, _RIGHT = 0, 1, 2


@jitable
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


@jitable
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


@jitable
def _rates(rates: Any, rows: Any, states: Any, place: int, arrangement: int, first: int, count: int, out: Any) -> None:
    loaded(rates, rows, states, place, arrangement, first, count)
    run(rates, rows, count)
    for j in range(len(out)):
        value = rates[3][j]
        for k in range(count):
            out[j, k] = rows[value, k]


@jitable
def defects(equations: Any, jump: Any, h: Any, states: Any, after: Any, middle: Any, defect: Any) -> None:
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


@jitable
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


@jitable
def slopes_at(slopes: Any, rows: Any, places: Any, states: Any, place: int, arrangement: int, first: int, count: int,
            out: Any) -> None:  # fmt: skip
    loaded(slopes, rows, states, place, arrangement, first, count)
    run(slopes, rows, count)
    for e in range(len(places)):
        i, j, value = places[e, 0], places[e, 1], slopes[3][e]
        for k in range(count):
            out[i, j, k] = rows[value, k]


@jitable
def linearise_about(
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
        slopes_at(slopes, rows, places, after, first, _LEFT, first, count, left)
        slopes_at(slopes, rows, places, middle, first, _MIDDLE, first, count, inside)
        slopes_at(slopes, rows, places, states, first + 1, _RIGHT, first, count, right)
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
    defects(equations, jump, h, states, after, middle, defect)
    linearise_about(equations, jump, h, states, after, middle, carries, inverse, behind, bend)


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
        slopes_at(slopes, rows, places, after, first, _LEFT, first, count, left)
        slopes_at(slopes, rows, places, middle, first, _MIDDLE, first, count, inside)
        slopes_at(slopes, rows, places, states, first + 1, _RIGHT, first, count, right)
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
