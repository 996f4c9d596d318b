"""A first guess of the states along an observer, by its corrections of a linearised open loop."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from mkc_torch.simulation.dynamics.flow import flow_along
from mkc_torch.simulation.dynamics.observer import CLIP, Observable, Observer
from mkc_torch.simulation.dynamics.trajectory import Trajectory
from mkc_torch.simulation.ports import Changes, Nearby


def first_observed(
    prepared: Observable, theta: Tensor, changes: Changes, near: Nearby | None, observer: Observer
) -> Trajectory | None:
    """Return where the states go along an observer, to first order about the open loop; None without an open loop.

    The open loop can be far from the observed states, and a solution that starts from there fails or has to march.

    Args:
        prepared: the simulation in open loop.
        theta: (p,), the parameters.
        changes: by effects, by port.
        near: of the open loop; see :meth:`mkc_torch.simulation.PreparedSimulation.answer`.
        observer: the gains.
    """
    free = prepared.trajectory(theta, changes, near)
    if not free.converged:
        return None
    states = free.states.detach()
    flow = flow_along(prepared, theta, states, changes)
    n, w, lasting = len(prepared.system.states), states.shape[1], observer.lasting
    gain, spread = observer.gain.double().cpu().numpy(), observer.spread.double().cpu().numpy()
    shows = np.zeros((flow.new.shape[1], len(lasting)))
    places = [prepared.disturbable.index(each.place) if each.at_rate else -1 for each in lasting]
    for number, each in enumerate(lasting):
        if not each.at_rate:
            shows[observer.outputs.index(each.place), number] = 1.0
    times = np.array([each.lasting for each in lasting])
    at_rate = np.array([place >= 0 for place in places], dtype=bool)
    before, after = np.zeros((len(flow.new), n + len(lasting))), np.zeros((len(flow.new), n + len(lasting)))
    for k in range(len(flow.new)):
        innovation = flow.new[k] - flow.seen[k] @ before[k, :n] - shows @ before[k, n:]
        moved = CLIP * spread[k] * np.tanh(innovation / (CLIP * spread[k]))
        after[k] = before[k] + gain[k] @ moved
        if k + 1 < len(flow.new) and flow.step[k] > 0.0:
            moves = flow.noise_input[k][:, places] * at_rate
            before[k + 1, :n] = flow.transition[k] @ after[k, :n] + moves @ after[k, n:]
            before[k + 1, n:] = np.exp(-flow.step[k] / times) * after[k, n:]
    if not np.isfinite(before).all():
        return None
    away = _at_grid_times(prepared, torch.as_tensor(before).to(states), torch.as_tensor(after).to(states))
    moved_states = torch.cat([states[:, :n] + away[:, :n], states[:, n:w], away[:, n:]], -1)
    return Trajectory(moved_states, True)


def _at_grid_times(prepared: Observable, before: Tensor, after: Tensor) -> Tensor:
    """Values at the samples before a correction, and between samples on a line from those after the correction."""
    rows, count = prepared.rows, len(prepared.grid.time)
    index = torch.arange(count, device=rows.device)
    last = (torch.searchsorted(rows, index, right=True) - 1).clamp(min=0)
    following = (last + 1).clamp(max=len(rows) - 1)
    share = ((index - rows[last]).clamp(min=0) / (rows[following] - rows[last]).clamp(min=1)).unsqueeze(-1)
    between = after[last] + share.to(after) * (before[following] - after[last])
    return torch.where((index == rows[last]).unsqueeze(-1), before[last], between)
