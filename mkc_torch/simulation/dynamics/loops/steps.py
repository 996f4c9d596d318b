"""The states of a simulation that steps, step after step."""

from __future__ import annotations

from typing import Any

from mkc_torch.simulation.dynamics.loops.programs import loaded, registers, run


def step_through(program: Any, step: Any, first: Any, states: Any) -> None:
    """Fill the states by ``x[k+1] = x[k] + step[k] rate(x[k])``.

    Args:
        program: of the rates; see :mod:`..programs`.
        step: (G-1,), length of each step; 0 where the next trajectory starts.
        first: (w, K), initial states of the trajectories.
        states: (w, G), filled.
    """
    outputs, w, place = program[3], len(first), 0
    rows = registers(program, w)
    for j in range(w):
        states[j, 0] = first[j, 0]
    for k in range(len(step)):
        if step[k] == 0.0:
            place += 1
            for j in range(w):
                states[j, k + 1] = first[j, place]
        else:
            loaded(program, rows, states, k, 0, k, 1)
            run(program, rows, 1)
            for j in range(w):
                states[j, k + 1] = states[j, k] + step[k] * rows[outputs[j], 0]
