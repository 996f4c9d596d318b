"""A filter over a whole flow: its runs side by side, or stretches until each begins where the one before it ends.

Multiple shooting: where stretches begin is found by Newton's method, with what a stretch keeps of its beginning.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from mkc_torch.simulation.dynamics.kalman import (
    Filtered,
    FilterEnd,
    FilterStart,
    Flow,
    Models,
    Parts,
    filtered,
    run,
    start_of,
)
from mkc_torch.simulation.dynamics.loops.kalman_filter import filter_samples
from mkc_torch.simulation.dynamics.loops.machine_code import machine_code

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

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
    """What :func:`filtered` leaves of a flow in one stretch.

    Without machine code the N steps of a few matrices are made in steps of many: three or four runs of a stretch's
    length, whatever N; where that is not enough, or N is small, as many steps as the longest run of the recording has
    samples.
    """
    N = len(flow.new)
    if not models.white.any() and not models.place.shape[1]:
        return _unpushed(flow, models)
    if machine_code(filter_samples) is not None:
        return filtered(flow.whole, models, keep=keep)
    if _FEW * _STRETCH > N:
        return _run_by_run(flow, models, keep=keep)
    stretches = _stretches(flow)
    start = _guess(flow, models)
    for _ in range(_ROUNDS):
        found, end = run(stretches, models, keep=keep, start=start)
        if _same(start, end):
            return _in_one(found, N)
        start = _passed_on(start, end)
    return _run_by_run(flow, models, keep=keep)


def _runs(flow: Flow) -> tuple[Int[np.ndarray, " G"], Int[np.ndarray, " G"]]:
    """First sample and length of each run: nothing of a state, nor of a disturbance, goes on from one to the next."""
    arrays = (flow.carried, flow.pushed, flow.shift)
    apart = (flow.step <= 0) & ~np.any([one.reshape(len(one), -1).any(-1) for one in arrays], 0)
    first = np.concatenate([[0], np.flatnonzero(apart) + 1])
    return first, np.diff(np.concatenate([first, [len(flow.new)]]))


def _run_by_run(flow: Flow, models: Models, *, keep: bool) -> Filtered:
    first, length = _runs(flow)
    if len(first) == 1:
        return filtered(flow.whole, models, keep=keep)
    row = np.arange(length.max())[:, None]
    there = row < length
    found = filtered(_gathered(flow, np.minimum(first + row, len(flow.new) - 1), there, there), models, keep=keep)

    def joined(values: np.ndarray) -> np.ndarray:
        return values.swapaxes(0, 1)[there.T][:, None] if len(values) else values

    return _each_array(found, joined)


def _stretches(flow: Flow) -> Parts:
    """Of equal length; the last sample of each is the first of the next one, and is not taken up."""
    N = len(flow.new)
    index = _STRETCH * np.arange(-(-N // _STRETCH)) + np.arange(_STRETCH + 1)[:, None]
    there = index < N
    own = there.copy()
    own[-1] = False
    return replace(_gathered(flow, np.minimum(index, N - 1), there, own), inside=index[0] > 0)


def _gathered(
    flow: Flow, at: Int[np.ndarray, "L G"], there: Bool[np.ndarray, "L G"], own: Bool[np.ndarray, "L G"]
) -> Parts:
    """Samples of these numbers, where there are any, as stretches that begin where a run does.

    Args:
        flow: the whole.
        at: numbers of the samples.
        there: whether a stretch goes on to a sample.
        own: whether it takes the sample up.
    """
    step, gone = np.minimum(at[:-1], len(flow.new) - 2), there[1:]
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
        np.zeros(at.shape[1], dtype=bool),
        flow.spread,
    )


def _guess(flow: Flow, models: Models) -> FilterStart:
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


def _passed_on(start: FilterStart, end: FilterEnd) -> FilterStart:
    """Each stretch begins where the one before it ends, had that begun where it now does."""
    states, covariances = [start.state[0]], [start.covariance[0]]
    for g, kept in enumerate(end.kept[:-1]):
        moved = states[-1] - start.state[g]
        states.append(end.state[g] + (kept @ moved[..., None])[..., 0])
        covariances.append(end.covariance[g] + kept @ (covariances[-1] - start.covariance[g]) @ kept.swapaxes(-1, -2))
    return FilterStart(np.stack(states), np.stack(covariances))


def _same(start: FilterStart, end: FilterEnd) -> bool:
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

    return _each_array(found, joined)


def _each_array(found: Filtered, joined: Callable[[np.ndarray], np.ndarray]) -> Filtered:
    return Filtered(
        joined(found.standard),
        joined(found.log_spread),
        joined(found.prior),
        joined(found.state),
        joined(found.after),
        joined(found.posterior),
    )
