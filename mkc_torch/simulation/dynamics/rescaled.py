"""What observers for larger and smaller pushes would leave of a series, along the trajectory of one of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mkc_torch.simulation.dynamics.disturbances import observer_of
from mkc_torch.simulation.dynamics.flow import flow_of
from mkc_torch.simulation.dynamics.kalman import Flow
from mkc_torch.simulation.dynamics.observer import Disturbance, Observable, Observer
from mkc_torch.simulation.protocol import Changes, Nearby

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["Rescaled", "rescaled"]


class Rescaled:
    """A linear map of whitened innovations of one observer, or of their tangents, to those of another one.

    Args:
        flow: along the trajectory of the one.
        one, other: the observers, for pushes at the same places of the same duration.
        rates: names of the states that can be pushed.
    """

    def __init__(self, flow: Flow, one: Observer, other: Observer, rates: Sequence[str]) -> None:
        self.other = other
        self._flow = flow
        self._n = flow.carried.shape[1]
        self._lasting = one.lasting
        self._places = [rates.index(push.place) if push.at_rate else -1 for push in one.lasting]
        self._back = np.linalg.inv(one.white.numpy())
        self._white = other.white.numpy()
        self._gains = one.gain.numpy(), other.gain.numpy()
        self._seen = self._with_pushes(flow, one)

    @staticmethod
    def _with_pushes(flow: Flow, one: Observer) -> Float[np.ndarray, "N m k"]:
        N, m, _ = flow.seen.shape
        own = np.zeros((m, len(one.lasting)))
        for number, push in enumerate(one.lasting):
            if not push.at_rate:
                own[one.outputs.index(push.place), number] = 1.0
        return np.concatenate([flow.seen, np.broadcast_to(own, (N, *own.shape))], -1)

    def __call__(self, values: Float[Tensor, "N m *rest"]) -> Float[Tensor, "N m *rest"]:
        flow, n = self._flow, self._n
        given = values.flatten(2).numpy() if values.dim() > 2 else values.unsqueeze(-1).numpy()
        out = np.empty_like(given)
        D = len(self._lasting)
        A = np.zeros((n + D, n + D))
        state = np.zeros((n + D, given.shape[-1]))
        before, after = self._gains
        for row in range(len(given)):
            if row:
                step = flow.step[row - 1]
                A[:n, :n] = flow.carried[row - 1]
                for number, place in enumerate(self._places):
                    if place >= 0:
                        A[:n, n + number] = flow.pushed[row - 1][:, place]
                    A[n + number, n + number] = np.exp(-step / self._lasting[number].lasting) if step > 0 else 0.0
                state = A @ state
            new = self._back[row] @ given[row]
            left = new - self._seen[row] @ state
            out[row] = self._white[row] @ left
            state = state + after[row] @ left - before[row] @ new
        return torch.from_numpy(out).reshape(values.shape)


def rescaled(
    prepared: Observable, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None, shares: Sequence[float]
) -> list[Rescaled]:
    """The maps to observers for these shares of an observer's pushes; none where there is no trajectory.

    Args:
        prepared: the observed simulation.
        theta, changes, near: of its trajectory.
        shares: of the pushes' sizes.
    """
    flow, one = flow_of(prepared, theta, changes, near), prepared.observer
    if flow is None or one is None:
        return []
    found = []
    for share in shares:
        pushes = tuple(Disturbance(d.place, d.at_rate, d.lasting, share * d.size) for d in one.disturbances)
        other = observer_of(flow, pushes, one.sensor, prepared.pushable, prepared.channels)
        assert other is not None
        found.append(Rescaled(flow, one, other, prepared.pushable))
    return found
