"""A filter over a whole flow, whose stretches run side by side until each begins where the one before it ends.

Multiple shooting: where stretches begin is found by Newton's method, with what a stretch keeps of its beginning.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from mkc_torch.simulation.dynamics.kalman import End, Filtered, Flow, Models, Parts, Start, filtered, run, start_of

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["filtered_whole"]

_STRETCH = 150
"""Samples of a stretch: several times as many as a filter takes to forget where it began."""

_ROUNDS = 6
"""Times that the stretches are run before the flow is filtered in one; three or four are usual."""

_FEW = 8
"""Stretches below which a flow is filtered in one."""

_SAME = 1e-7
"""Of a standard deviation: by so much the beginning of a stretch and the end of the one before it may differ."""


def filtered_whole(flow: Flow, models: Models, *, keep: bool = False) -> Filtered:
    """What :func:`filtered` leaves of a flow in one stretch, N steps of a few matrices, in steps of many.

    It takes three or four runs of a stretch's length, whatever N; where that is not enough, one of the flow's.
    """
    N = len(flow.new)
    if not models.white.any() and not models.place.shape[1]:
        return _unpushed(flow, models)
    if _FEW * _STRETCH > N:
        return filtered(flow.whole, models, keep=keep)
    stretches = _stretches(flow)
    start = _guess(flow, models)
    for _ in range(_ROUNDS):
        found, end = run(stretches, models, keep=keep, start=start)
        if _same(start, end):
            return _in_one(found, N)
        start = _passed_on(start, end)
    return filtered(flow.whole, models, keep=keep)


def _stretches(flow: Flow) -> Parts:
    """Of equal length; the last sample of each is the first of the next one, and is not taken up."""
    N = len(flow.new)
    index = _STRETCH * np.arange(-(-N // _STRETCH)) + np.arange(_STRETCH + 1)[:, None]
    there, at = index < N, np.minimum(index, N - 1)
    own = there.copy()
    own[-1] = False
    step, gone = np.minimum(index[:-1], N - 2), there[1:]
    counts = np.where(own[..., None], flow.counts[at], 0.0)
    return Parts(
        np.where(gone[..., None, None], flow.carried[step], 0.0),
        np.where(gone[..., None, None], flow.pushed[step], 0.0),
        flow.seen[at],
        flow.new[at],
        np.where(gone[..., None], flow.shift[step], 0.0),
        np.where(gone, flow.step[step], 0.0),
        counts,
        counts,
        index[0] > 0,
        flow.spread,
    )


def _guess(flow: Flow, models: Models) -> Start:
    """States that no push reaches are where the flow carries them; the others are about where the trajectory is."""
    way = _way(flow)[::_STRETCH]
    reached = _reached(flow, models)
    inside = (np.arange(len(way)) > 0)[:, None, None]
    start = start_of(np.where(inside & reached, flow.spread, 0.0), models)
    state = start.state.copy()
    state[..., : way.shape[1]] = np.where(reached, 0.0, way[:, None])
    return replace(start, state=state)


def _reached(flow: Flow, models: Models) -> Bool[np.ndarray, "B n"]:
    """States that a model's pushes move, at once or by way of others."""
    p = flow.rates
    pushes = models.white > 0
    for place, size in zip(models.place.T, models.size.T, strict=True):
        pushes |= (np.arange(p) == place[:, None]) & (size > 0)[:, None]
    reached = pushes @ flow.pushed.any(0).T.astype(float) > 0
    carries = flow.carried.any(0).astype(float)
    for _ in range(carries.shape[0]):
        reached |= reached @ carries.T > 0
    return reached


def _way(flow: Flow) -> Float[np.ndarray, "N n"]:
    """Where the flow carries the states that are corrected by nothing."""
    way = np.zeros((len(flow.new), flow.carried.shape[1]))
    if flow.shift.any():
        for row, (carry, shift) in enumerate(zip(flow.carried, flow.shift, strict=True)):
            way[row + 1] = carry @ way[row] - shift
    return way


def _unpushed(flow: Flow, models: Models) -> Filtered:
    """Without a push the states are known, and no sample says anything of them."""
    way, B = _way(flow), len(models)
    new = flow.new - np.einsum("kmn,kn->km", flow.seen, way)
    standard = new[:, None, None] / models.sensor
    state = np.broadcast_to(way[:, None, None], (len(way), 1, B, way.shape[1]))
    covariance = np.zeros((*state.shape, way.shape[1]))
    log_spread = np.broadcast_to(np.log(models.sensor), standard.shape)
    return Filtered(standard, log_spread, covariance, state, state, covariance)


def _passed_on(start: Start, end: End) -> Start:
    """Each stretch begins where the one before it ends, had that begun where it now does."""
    states, covariances = [start.state[0]], [start.covariance[0]]
    for g, kept in enumerate(end.kept[:-1]):
        moved = states[-1] - start.state[g]
        states.append(end.state[g] + (kept @ moved[..., None])[..., 0])
        covariances.append(end.covariance[g] + kept @ (covariances[-1] - start.covariance[g]) @ kept.swapaxes(-1, -2))
    return Start(np.stack(states), np.stack(covariances))


def _same(start: Start, end: End) -> bool:
    """Whether each stretch begins where the one before it ends."""
    state, covariance = end.state[:-1], end.covariance[:-1]
    size = np.sqrt(np.maximum(covariance.diagonal(axis1=-2, axis2=-1), 0.0))
    near = np.abs(start.state[1:] - state) <= _SAME * (size + np.abs(state))
    alike = np.abs(start.covariance[1:] - covariance) <= _SAME * size[..., :, None] * size[..., None, :]
    return bool(near.all() and alike.all())


def _in_one(found: Filtered, N: int) -> Filtered:
    """Stretches one after the other."""

    def joined(values: np.ndarray) -> np.ndarray:
        return values[:-1].swapaxes(0, 1).reshape(-1, 1, *values.shape[2:])[:N] if len(values) else values

    return Filtered(
        joined(found.standard),
        joined(found.log_spread),
        joined(found.prior),
        joined(found.state),
        joined(found.after),
        joined(found.posterior),
    )
