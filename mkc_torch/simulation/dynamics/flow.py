"""A simulation's trajectory, linearised from sample to sample."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.simulation.dynamics.kalman import Flow
from mkc_torch.simulation.dynamics.observer import Observable
from mkc_torch.simulation.dynamics.trajectory import carried, slopes
from mkc_torch.simulation.protocol import Changes, Nearby

if TYPE_CHECKING:
    from jaxtyping import Float


__all__ = ["flow_along", "flow_of", "plausible_sizes"]

_ABOUT = 0.1
"""Share of its spread by which a state may be off at least."""


_USUAL = 0.99
"""Quantile of a state's rates over a recording that process noise may be as large as."""


_SLOW = 0.5
"""Share of an output's robust variation that a slow error of its sensor may have at most."""


def plausible_sizes(
    prepared: Observable, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None
) -> Float[np.ndarray, " p+m"]:
    """Plausible sizes of process noise of each rate, and of a slow error of each output, in their units.

    Process noise is no larger than the rates that this recording shows; a sensor's error is smaller than what it shows.

    Args:
        prepared: the simulation.
        theta, changes, near: of its trajectory.
    """
    system = prepared.system
    n = len(system.states)
    states = prepared.trajectory(theta, changes, near).states.detach()
    free = prepared.observed(None)
    own, guess = states[:, : states.shape[1] - len(prepared.lasting)], prepared.guess[:, :n]
    # a free run may rest where the recording moves
    ways = (own, torch.cat([guess, own[:, n:]], -1))
    shown, span = torch.zeros_like(own[0, :n]), own[:, :n].amax(0) - own[:, :n].amin(0)
    for way in ways:
        rates = free.rate(theta, changes)(prepared.grid.spread(way))[::3, :n].detach().abs().nan_to_num(0.0, 0.0)
        shown = torch.maximum(shown, torch.quantile(rates, _USUAL, 0))
    lasted = (prepared.time[-1] - prepared.time[0]).clamp(min=torch.finfo(span.dtype).tiny)
    places = [system.states.index(name) for name in prepared.pushable]
    varies = _SLOW * robust_scale(prepared.measured - prepared.measured.median(0).values)
    varies = torch.where(varies > 0, varies, torch.inf)
    largest: np.ndarray = torch.cat([torch.maximum(shown, span / lasted)[places], varies]).double().cpu().numpy()
    return largest


def flow_of(
    prepared: Observable,
    theta: Float[Tensor, " p"],
    changes: Changes,
    near: Nearby | None,
) -> Flow | None:
    """The flow near a trajectory, free or observed; None where there is no trajectory.

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
    """The flow near given states at the moments of the grid, as if they were a trajectory."""
    n = len(prepared.system.states)
    step = prepared.grid.step
    rate, jump = prepared.rate(theta, changes), prepared.jump(theta, changes)
    # internal states of effects and pushes are where they are; what is linearised are the system's own
    A, _ = carried(rate, states, step.unsqueeze(-1), jump)
    A = A[:, :n, :n].detach()
    places = [prepared.system.states.index(name) for name in prepared.pushable]
    unit = torch.eye(n, dtype=states.dtype)[:, places]
    G = step[:, None, None] * 0.5 * (unit + A @ unit)
    carry, push = _between_samples(A, G, prepared.rows)
    at = states[prepared.rows]
    predict = prepared.predicted(theta)
    C = slopes(predict, at)[..., :n].detach()
    new = (prepared.seen(theta, changes) - predict(at)).detach()
    after = at if jump is None else jump.applied(states)[prepared.rows].detach()
    # the trajectory itself moved by its corrections and pushes
    shift = torch.einsum("kij,kj->ki", carry, (after - at)[:-1, :n])
    for number, one in enumerate(prepared.lasting):
        if one.at_rate:
            value = after[:-1, states.shape[1] - len(prepared.lasting) + number]
            shift = shift + push[:, :, prepared.pushable.index(one.place)] * value.unsqueeze(-1)
    gap = torch.where(prepared.begins[1:], 0.0, prepared.time.diff())
    arrays = (carry, push, C, new, shift, gap, prepared.counts.to(new.dtype), _may_be_off(prepared, at[:, :n], new))
    return Flow(*(one.detach().cpu().numpy().astype(np.float64) for one in arrays))


def _may_be_off(prepared: Observable, at: Float[Tensor, "N n"], new: Float[Tensor, "N m"]) -> Float[Tensor, " n"]:
    """By how much states may be off along a trajectory: the share of their spread that the outputs are off by.

    One that rests where something pushes has no spread of its own; a first guess of its states has.
    """
    used = prepared.counts.to(new.dtype)
    total = used.sum(0).clamp(min=1.0)
    level = (used * prepared.measured).sum(0) / total
    off = (used * new.square()).sum(0) / total
    whole = (used * (prepared.measured - level).square()).sum(0) / total
    share = (off / whole.clamp(min=torch.finfo(new.dtype).tiny)).sqrt().amax().clamp(_ABOUT, 1.0)
    return share * torch.maximum(at.std(0), prepared.guess[prepared.rows].std(0))


def _between_samples(A: Tensor, G: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """From node to node joined to from sample to sample."""
    count = rows.diff()
    n = A.shape[1]
    carry = torch.eye(n, dtype=A.dtype).expand(len(count), n, n).clone()
    push = A.new_zeros(len(count), n, G.shape[-1])
    for part in range(int(count.max())):
        there = part < count
        at = (rows[:-1] + part)[there]
        push[there] = A[at] @ push[there] + G[at]
        carry[there] = A[at] @ carry[there]
    return carry, push
