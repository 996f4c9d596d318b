"""What observers for larger and smaller pushes would leave of a series, along the trajectory of one of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mkc_torch.simulation.dynamics.disturbances import observer_of
from mkc_torch.simulation.dynamics.flow import flow_of
from mkc_torch.simulation.dynamics.kalman import Flow
from mkc_torch.simulation.dynamics.observer import Disturbance, Observable, Observer, clipped, clipped_slope
from mkc_torch.simulation.protocol import Changes, Nearby

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["Rescaled", "rescaled", "unclipped"]


class Rescaled:
    """A linear map of whitened innovations of one observer, or of their tangents, to those of another one.

    Args:
        flow: along the trajectory of the one.
        one, other: the observers, for pushes at the same places of the same duration.
        rates: names of the states that can be pushed.
        slope: (N, m), of what the one is corrected by over its innovation; 1 where it is linear.
    """

    def __init__(
        self, flow: Flow, one: Observer, other: Observer, rates: Sequence[str], slope: Float[np.ndarray, "N m"]
    ) -> None:
        self.other = other
        self._slope = slope
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
            state = state + after[row] @ left - before[row] @ (self._slope[row][:, None] * new)
        return torch.from_numpy(out).reshape(values.shape)


def rescaled(
    prepared: Observable,
    theta: Float[Tensor, " p"],
    changes: Changes,
    near: Nearby | None,
    shares: Sequence[float],
    counts: Float[Tensor, "N m"] | None = None,
) -> list[Rescaled]:
    """The maps to observers for these shares of an observer's pushes; none where there is no trajectory.

    Args:
        prepared: the observed simulation.
        theta, changes, near: of its trajectory.
        shares: of the pushes' sizes.
        counts: 0 for samples that correct nothing; with them the maps are of what :func:`unclipped` gives.
    """
    found = _along(prepared, theta, changes, near, counts)
    if found is None:
        return []
    flow, one = found
    maps, linear = [], np.ones(one.spread.shape)
    for share in shares:
        pushes = tuple(Disturbance(d.place, d.at_rate, d.lasting, share * d.size) for d in one.disturbances)
        other = observer_of(flow, pushes, one.sensor, prepared.pushable, prepared.channels)
        assert other is not None
        maps.append(Rescaled(flow, one, other, prepared.pushable, linear))
    return maps


def unclipped(
    prepared: Observable,
    theta: Float[Tensor, " p"],
    changes: Changes,
    near: Nearby | None,
    counts: Float[Tensor, "N m"],
) -> tuple[Rescaled, Rescaled] | None:
    """The maps to the same pushes' observer with no limit to its corrections: of innovations, and of their tangents.

    An observer corrects by no more than a few standard deviations, so that an outlier does not carry it away, and by a
    little less than its gain already at one of them, which adds up to much over a recording.

    Args:
        prepared, theta, changes, near, counts: as of :func:`rescaled`.
    """
    found = _along(prepared, theta, changes, near, counts)
    if found is None or prepared.observer is None:
        return None
    flow, other = found
    one = prepared.observer
    new, spread = torch.from_numpy(flow.new), one.spread.double().cpu()
    taken = torch.where(new == 0, 1.0, clipped(new, spread) / torch.where(new == 0, 1.0, new))
    series, tangents = (
        Rescaled(flow, one, other, prepared.pushable, slope.numpy()) for slope in (taken, clipped_slope(new, spread))
    )
    return series, tangents


def _along(
    prepared: Observable,
    theta: Float[Tensor, " p"],
    changes: Changes,
    near: Nearby | None,
    counts: Float[Tensor, "N m"] | None,
) -> tuple[Flow, Observer] | None:
    """The flow, and the observer of the same pushes along it with the samples that count."""
    flow, one = flow_of(prepared, theta, changes, near), prepared.observer
    if flow is None or one is None:
        return None
    if counts is None:
        return flow, one
    flow = replace(flow, counts=flow.counts * counts.double().cpu().numpy())
    other = observer_of(flow, one.disturbances, one.sensor, prepared.pushable, prepared.channels)
    assert other is not None
    return flow, other
