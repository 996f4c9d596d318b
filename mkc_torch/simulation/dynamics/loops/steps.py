"""The states of a simulation that steps, step after step."""

from __future__ import annotations

from typing import Any

import numpy as np

from mkc_torch.simulation.dynamics.loops.programs import jitable, loaded, registers, run


@jitable
def _correct(jump: Any, rows: Any, after: Any, sample: int) -> None:
    """Add an observer's correction at a sample to the states (w, 1)."""
    new, gain, limit, corrects, _ = jump
    loaded(new, rows, after, 0, 0, sample, 1)
    run(new, rows, 1)
    for output in range(len(limit)):
        most = limit[output, sample]
        moved = most * np.tanh(rows[new[3][output], 0] / most)
        for i in range(len(corrects)):
            after[corrects[i], 0] += gain[i, output, sample] * moved


def step_through(program: Any, jump: Any, step: Any, first: Any, states: Any) -> None:
    """Fill the states before each grid time by ``x[k+1] = x'[k] + step[k] rate(x'[k])``, x' with an observer's jump.

    Args:
        program: of the rates; see :mod:`..programs`.
        jump: an observer: the program of the innovations, the gain (k, m, N), the limit (m, N), the indices of the
            corrected states, and for each grid time the index of its sample, or -1. The index is empty without one.
        step: (G-1,), length of each step; 0 where the next trajectory starts.
        first: (w, K), initial states of the trajectories.
        states: (w, G), filled.
    """
    outputs, w, place, sample = program[3], len(first), 0, jump[4]
    rows, innovations, after = registers(program, w), registers(jump[0], w), np.empty((w, 1))
    for j in range(w):
        states[j, 0] = first[j, 0]
    for k in range(len(step)):
        if step[k] == 0.0:
            place += 1
            for j in range(w):
                states[j, k + 1] = first[j, place]
        else:
            for j in range(w):
                after[j, 0] = states[j, k]
            if len(sample) > 0 and sample[k] >= 0:
                _correct(jump, innovations, after, sample[k])
            loaded(program, rows, after, 0, 0, k, 1)
            run(program, rows, 1)
            for j in range(w):
                states[j, k + 1] = after[j, 0] + step[k] * rows[outputs[j], 0]
