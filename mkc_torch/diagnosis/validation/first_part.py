"""The first part of each trajectory, from which the initial states of a new recording are estimated."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.dual_constants import dual_constants
from mkc_torch.diagnosis.validation.blocks import PART
from mkc_torch.nonlinear import load_forward_mode
from mkc_torch.simulation.dynamics.correction import DynamicsCorrection
from mkc_torch.simulation.dynamics.first_fit import floor_of
from mkc_torch.simulation.dynamics.initial_states import InitialStates
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics
from mkc_torch.simulation.ports import Changes

if TYPE_CHECKING:
    from jaxtyping import Float

_SAMPLES_PER_STATE = 5
"""Samples of the first part for each initial state, at least."""

_PARTS = 5
"""Largest first part in tenths of a trajectory: at least half is predicted."""

_ADDED = 0.25
"""Variance that the error of the initial states may add to the predictions, as a share of the noise's: 12 % of the
RMSE, less than the width of its interval by nine blocks."""


def checked_start(prepared: PreparedDynamics, seconds: float | None) -> float:
    """Return the length in s of the part of each trajectory that the initial states are estimated from.

    Args:
        prepared: the simulation with a recording.
        seconds: as given; None for a tenth of the shortest trajectory, but at least five samples for each state.

    Raises:
        ValueError: the part is not positive, has fewer samples than a trajectory has initial states, or leaves nothing
            to predict.
    """
    parts = _trajectories(prepared, prepared.time_since_start())
    states = len(prepared.system.states) - len(prepared.system.starts_as)
    shortest = min(float(part[-1]) for part in parts)
    fewest = max(float(part[min(states, len(part)) - 1]) for part in parts)
    if seconds is None:
        enough = max(float(part[min(_SAMPLES_PER_STATE * states, len(part)) - 1]) for part in parts)
        seconds = max(PART * shortest, enough)
        if seconds >= shortest:
            raise ValueError(
                f"{prepared.name}: the shortest trajectory has {min(map(len, parts))} samples, but "
                f"{_SAMPLES_PER_STATE * states} are needed for its {states} initial states, and more for a prediction. "
                "Record longer, or give the seconds with `start_seconds` (`--start-seconds`)."
            )
    if not fewest <= seconds < shortest or seconds <= 0.0:
        raise ValueError(
            f"Expected argument `start_seconds` to be at least {fewest:.4g} s, which has a sample for each of the "
            f"{states} initial states, and less than {shortest:.4g} s, the length of the shortest trajectory, but got "
            f"{seconds:.4g}; give another with `--start-seconds`."
        )
    return seconds


def enough_seconds(
    correction: DynamicsCorrection, theta: Float[Tensor, " p"], changes: Changes, starts: InitialStates
) -> float:
    """Return the length in s of the shortest first part that is enough for the initial states.

    A small error of an initial speed grows with time, so a tenth of a trajectory can be too short for a prediction of
    the rest. The part is lengthened by tenths of the shortest trajectory, up to half, until the error of the initial
    states adds at most a quarter of the white noise's variance to the predicted samples of each output, on average.

    Args:
        correction: the simulation on a recording, with a first part of the shortest length.
        theta: (p,), the parameters.
        changes: the changes at the ports.
        starts: the initial states that were estimated from it.
    """
    prepared, least = correction.prepared, correction.first
    assert least is not None
    since = prepared.time_since_start()
    slopes = _slopes(correction, theta, changes, starts) / floor_of(prepared).unsqueeze(-1)
    if prepared.recorded is not None:
        slopes = slopes * prepared.recorded.unsqueeze(-1)
    shortest = min(float(part[-1]) for part in _trajectories(prepared, since))
    seconds = least
    for number in range(1, _PARTS + 1):
        seconds = max(least, number * PART * shortest)
        if _added_variance(prepared, slopes, seconds) <= _ADDED:
            break
    return seconds


def _added_variance(prepared: PreparedDynamics, slopes: Float[Tensor, "N m f"], seconds: float) -> float:
    """Return the variance by the initial states' error, in units of the noise's, of the output with the most."""
    since = prepared.time_since_start()
    total, count = slopes.new_zeros(slopes.shape[1]), 0
    each = zip(_trajectories(prepared, slopes), _trajectories(prepared, since), strict=True)
    for slope, at in each:
        first = slope[at <= seconds].flatten(0, 1)
        later = slope[at > seconds]
        # a state that the first part does not determine has no finite error
        scale = torch.linalg.vector_norm(first, dim=0).clamp(min=torch.finfo(first.dtype).tiny)
        information = (first / scale).mT @ (first / scale)
        covariance = torch.linalg.pinv(information, hermitian=True)
        total = total + ((later / scale) @ covariance * (later / scale)).sum(-1).sum(0)
        count += len(later)
    return float(total.max()) / count if count else 0.0


def _slopes(
    correction: DynamicsCorrection, theta: Float[Tensor, " p"], changes: Changes, starts: InitialStates
) -> Float[Tensor, "N m f"]:
    """Return the derivatives of the outputs by the estimated initial states of their own trajectory."""
    own = correction.own_states
    free = own.free(starts.values)
    trajectories = int(correction.prepared.begins.sum())

    def moved(step: Tensor) -> Tensor:
        # no trajectory depends on another's states, so all of them are moved at once
        states = own.all(free + step.repeat(trajectories))
        return correction.simulated(theta, changes, InitialStates(states, starts.near))

    load_forward_mode()
    step = free.new_zeros(len(free) // trajectories)
    return torch.func.jacfwd(dual_constants(moved))(step).detach()


def _trajectories(prepared: PreparedDynamics, values: Tensor) -> list[Tensor]:
    """Return the values of each trajectory."""
    ends = [*prepared.begins.nonzero().squeeze(-1).tolist(), len(values)]
    return [values[low:high] for low, high in pairwise(ends)]
