"""How well a corrected simulation runs free on a recording that it has not seen, beside the true system."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from torch import Tensor

from mkc_torch.challenge.dynamics.errors import Errors
from mkc_torch.challenge.dynamics.integrate import simulate
from mkc_torch.challenge.dynamics.oracle import least_squares
from mkc_torch.challenge.dynamics.plant import Array, HiddenTerm, Plant, RunSet
from mkc_torch.challenge.key import Key
from mkc_torch.recording.recording import Recording


def oracle_rms(
    plant: Plant, trial: RunSet, hidden: HiddenTerm, size: float, errors: Errors, left: Array, good: np.ndarray
) -> float:
    """Root mean square of what the true system leaves on good samples, its first state estimated from them.

    Args:
        plant, trial, hidden, size: the truth.
        errors: of the outputs.
        left: measured less true outputs (m, T, R).
        good: samples that are no outliers (m, T, R).

    Returns:
        In standard deviations of the outputs' errors.
    """
    scale = np.reshape(errors.deviations, (-1, 1, 1))
    reach = 1e-4 * (np.abs(trial.begin).max(1) + 1e-3)
    n, runs = trial.begin.shape
    # the truth, and beside it one more copy of all runs for each state that begins elsewhere
    begin = np.tile(trial.begin, n + 1)
    for state in range(n):
        begin[state, runs * (state + 1) : runs * (state + 2)] += reach[state]
    copies = replace(trial, inputs=np.tile(trial.inputs, n + 1), begin=begin)
    truth, *moved = np.split(simulate(plant, copies, hidden, size).outputs, n + 1, -1)
    columns: list[Array] = []
    rest = (left / scale)[good]
    if not moved:  # a system without states has nothing to begin with
        return float(np.sqrt(np.square(rest).mean()))
    for state, there in enumerate(moved):
        change = (there - truth) / scale / reach[state]
        columns += [np.where(np.arange(runs) == run, change, 0.0)[good] for run in range(runs)]
    tangent = np.stack(columns, -1)
    rest = rest - tangent @ least_squares(tangent, rest)
    return float(np.sqrt(np.square(rest).mean()))


def ratio_to_oracle(simulated: Mapping[str, Tensor], second: Recording, key: Key) -> float:
    """Root mean square error of a free run on good samples, relative to the oracle's.

    Args:
        simulated: the outputs of the corrected simulation.
        second: the recording they are to follow.
        key: of the case, with ``oracle_rms``, the errors' standard deviations, and the outliers, which are numbered
            output by output.

    Returns:
        The ratio; infinite where the run is not finite.
    """
    deviations: Mapping[str, float] = key.noise["deviation"]
    error = np.concatenate(
        [(simulated[name] - second[name]).double().numpy() / deviation for name, deviation in deviations.items()]
    )
    good = np.ones(len(error), dtype=bool)
    good[list(key.second_outliers)] = False
    rms = float(np.sqrt(np.square(error[good]).mean()))
    return rms / key.oracle_rms if math.isfinite(rms) else math.inf
