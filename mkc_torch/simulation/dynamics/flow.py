"""Linearise a simulation's trajectory from sample to sample."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.simulation.dynamics.kalman import Flow
from mkc_torch.simulation.dynamics.observer import Observable
from mkc_torch.simulation.dynamics.trajectory import slopes, transition_matrices
from mkc_torch.simulation.ports import Changes, Nearby

if TYPE_CHECKING:
    from jaxtyping import Float

_LEAST_STATE_ERROR = 0.1
"""Smallest assumed error of a state, as a share of its standard deviation."""

_RATE_QUANTILE = 0.99
"""Quantile of a state's rates over the recording that limits its process noise."""

_DRIFT_SHARE = 0.5
"""Largest drift of a sensor, as a share of its output's robust scale."""


def plausible_sizes(
    prepared: Observable, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None
) -> Float[np.ndarray, " p+m"]:
    """Largest plausible process noise of each rate, and drift of each output, in their units.

    Process noise is no larger than the rates in this recording. Drift is smaller than the output's variation.

    Args:
        prepared: the simulation.
        theta, changes, near: of its trajectory; see :meth:`mkc_torch.simulation.PreparedSimulation.answer`.
    """
    system = prepared.system
    n = len(system.states)
    states = prepared.trajectory(theta, changes, near).states.detach()
    free = prepared.observed(None)
    own, guess = states[:, : states.shape[1] - len(prepared.lasting)], prepared.guess[:, :n]
    # the open loop may stand still where the recording moves
    courses = (own, torch.cat([guess, own[:, n:]], -1))
    shown, span = torch.zeros_like(own[0, :n]), own[:, :n].amax(0) - own[:, :n].amin(0)
    for course in courses:
        rates = free.rate(theta, changes)(prepared.grid.spread(course))[:: prepared.grid.per_interval, :n]
        rates = rates.detach().abs().nan_to_num(0.0, 0.0)
        shown = torch.maximum(shown, torch.quantile(rates, _RATE_QUANTILE, 0))
    lasted = (prepared.time[-1] - prepared.time[0]).clamp(min=torch.finfo(span.dtype).tiny)
    places = [system.states.index(name) for name in prepared.disturbable]
    varies = _DRIFT_SHARE * robust_scale(prepared.measured - prepared.measured.median(0).values)
    varies = torch.where(varies > 0, varies, torch.inf)
    largest: np.ndarray = torch.cat([torch.maximum(shown, span / lasted)[places], varies]).double().cpu().numpy()
    return largest


def changes_by_inputs(prepared: Observable, theta: Float[Tensor, " p"]) -> Float[np.ndarray, " p"]:
    """How much the inputs change each rate that a disturbance can act on, along the first guess of the states.

    The servo of a joint and its friction cancel nearly, so each alone can be far larger than the rates of a recording.

    Args:
        prepared: the simulation.
        theta: its parameters.

    Returns:
        The quantile of the rates' differences from those with all inputs at their medians, in the rates' units.
    """
    free = prepared.observed(None)
    at, now = free.grid.spread(free.guess), free.acting(theta, {})
    held = now._replace(inputs=now.inputs.median(0).values.expand_as(now.inputs))
    own, without = (free.rate(theta, {}, acting)(at) for acting in (now, held))
    places = [free.system.states.index(name) for name in free.disturbable]
    moved = (own - without)[:: free.grid.per_interval, places].detach().abs().nan_to_num(0.0, 0.0)
    changes: np.ndarray = torch.quantile(moved, _RATE_QUANTILE, 0).double().cpu().numpy()
    return changes


def flow_of(prepared: Observable, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None) -> Flow | None:
    """Linearise a trajectory, in open loop or with an observer; None where no trajectory is found.

    Args:
        prepared: the simulation.
        theta, changes, near: of the trajectory; see :meth:`mkc_torch.simulation.PreparedSimulation.answer`.
    """
    found = prepared.trajectory(theta, changes, near)
    return flow_along(prepared, theta, found.states.detach(), changes) if found.converged else None


def flow_along(
    prepared: Observable,
    theta: Float[Tensor, " p"],
    states: Float[Tensor, "G n"],
    changes: Changes = MappingProxyType({}),
) -> Flow:
    """Linearise about given states at the grid times, as if they were a trajectory."""
    n = len(prepared.system.states)
    step = prepared.grid.step
    rate, jump = prepared.rate(theta, changes), prepared.jump(theta, changes)
    # only the system's own states are linearised; those of effects and disturbances are held fixed
    A, _ = transition_matrices(rate, states, prepared.grid, jump)
    A = A[:, :n, :n].detach()
    places = [prepared.system.states.index(name) for name in prepared.disturbable]
    unit = torch.eye(n, dtype=states.dtype)[:, places]
    G = step[:, None, None] * 0.5 * (unit + A @ unit)
    carry, noise_input = _between_samples(A, G, prepared.rows)
    at = states[prepared.rows]
    predict = prepared.predicted(prepared.acting_at_samples(theta, changes), changes)
    C = slopes(predict, at)[..., :n].detach()
    # what sensors and output effects add follows the trajectory, whose disturbances are estimated again
    new = prepared.measured - prepared.outputs_by_states(theta, changes, at) + prepared.output_disturbance(at)
    after = at if jump is None else jump.applied(states)[prepared.rows].detach()
    # corrections and disturbances of an observer moved the trajectory itself
    shift = (carry @ (after - at)[:-1, :n].unsqueeze(-1)).squeeze(-1)
    for number, disturbance in enumerate(prepared.lasting):
        if disturbance.at_rate:
            value = after[:-1, states.shape[1] - len(prepared.lasting) + number]
            shift = shift + noise_input[:, :, prepared.disturbable.index(disturbance.place)] * value.unsqueeze(-1)
    gap = torch.where(prepared.begins[1:], 0.0, prepared.time.diff())
    arrays = (
        carry,
        noise_input,
        C,
        new,
        shift,
        gap,
        prepared.counts.to(new.dtype),
        _state_errors(prepared, at[:, :n], new),
    )
    return Flow(*(array.detach().cpu().numpy().astype(np.float64) for array in arrays))


def _state_errors(prepared: Observable, at: Float[Tensor, "N n"], new: Float[Tensor, "N m"]) -> Float[Tensor, " n"]:
    """Assumed error of each state along a trajectory: the outputs' relative error times the state's spread.

    A simulated state that stands still has no spread; the first guess of the states provides it then.
    """
    used = prepared.counts.to(new.dtype)
    total = used.sum(0).clamp(min=1.0)
    level = (used * prepared.measured).sum(0) / total
    off = (used * new.square()).sum(0) / total
    whole = (used * (prepared.measured - level).square()).sum(0) / total
    share = (off / whole.clamp(min=torch.finfo(new.dtype).tiny)).sqrt().amax().clamp(_LEAST_STATE_ERROR, 1.0)
    return share * torch.maximum(at.std(0), prepared.guess[prepared.rows].std(0))


def _between_samples(A: Tensor, G: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Compose transitions and noise inputs between grid times to those between samples."""
    count = rows.diff()
    n = A.shape[1]
    carry = torch.eye(n, dtype=A.dtype).expand(len(count), n, n).clone()
    noise_input = A.new_zeros(len(count), n, G.shape[-1])
    for part in range(int(count.max())):
        there = part < count
        at = (rows[:-1] + part)[there]
        noise_input[there] = A[at] @ noise_input[there] + G[at]
        carry[there] = A[at] @ carry[there]
    return carry, noise_input
