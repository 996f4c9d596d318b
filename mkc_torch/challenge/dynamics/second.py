"""Open-loop error of a corrected simulation on an unseen recording, relative to the true system."""

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
