"""Filter a whole flow in parallel: run by run, or in stretches by multiple shooting.

Newton's method finds the start of each stretch, until it equals the end of the stretch before.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from mkc_torch.simulation.dynamics.kalman import (
    Filtered,
    FilterEnd,
    FilterModels,
    FilterStart,
    Flow,
    FlowParts,
    filtered,
    run_filter,
    start_of,
)
from mkc_torch.simulation.dynamics.loops.kalman_filter import filter_samples
from mkc_torch.simulation.dynamics.loops.machine_code import machine_code

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_STRETCH = 150
"""Samples of a stretch: several times as many as a filter needs to converge."""

_MOST_ROUNDS = 6
"""Newton iterations before the flow is filtered in one stretch instead; three or four are usual."""

_FEWEST_STRETCHES = 8
"""Number of stretches below which a flow is filtered run by run."""

_AGREEMENT = 1e-7
"""Largest difference between a stretch's start and the end of the stretch before, in standard deviations."""


def filtered_whole(flow: Flow, models: FilterModels, *, keep: bool = False) -> Filtered:
    """The result of :func:`filtered` for a flow in one stretch.

    Without machine code, stretches are filtered in parallel: three or four passes of a stretch's length, whatever N.
    Where these do not converge, or N is small, runs are filtered in parallel, in a pass of the longest run's length.
    """
    N = len(flow.new)
    if not models.white.any() and not models.place.shape[1]:
        return _without_process_noise(flow, models)
    if machine_code(filter_samples) is not None:
        return filtered(flow.whole, models, keep=keep)
    if _FEWEST_STRETCHES * _STRETCH > N:
        return _run_by_run(flow, models, keep=keep)
    stretches = _stretches(flow)
    start = _first_starts(flow, models)
    for _ in range(_MOST_ROUNDS):
        found, end = run_filter(stretches, models, keep=keep, start=start)
        if _starts_agree(start, end):
            return _concatenated(found, N)
        start = _next_starts(start, end)
    return _run_by_run(flow, models, keep=keep)


def _runs(flow: Flow) -> tuple[Int[np.ndarray, " G"], Int[np.ndarray, " G"]]:
    """First sample and length of each run; neither states nor disturbances carry over to the next run."""
    arrays = (flow.transition, flow.noise_input, flow.shift)
    apart = (flow.step <= 0) & ~np.any([array.reshape(len(array), -1).any(-1) for array in arrays], 0)
    first = np.concatenate([[0], np.flatnonzero(apart) + 1])
    return first, np.diff(np.concatenate([first, [len(flow.new)]]))


def _run_by_run(flow: Flow, models: FilterModels, *, keep: bool) -> Filtered:
    first, length = _runs(flow)
    if len(first) == 1:
        return filtered(flow.whole, models, keep=keep)
    row = np.arange(length.max())[:, None]
    there = row < length
    found = filtered(_gathered(flow, np.minimum(first + row, len(flow.new) - 1), there, there), models, keep=keep)

    def joined(values: np.ndarray) -> np.ndarray:
        return values.swapaxes(0, 1)[there.T][:, None] if len(values) else values

    return _each_array(found, joined)


def _stretches(flow: Flow) -> FlowParts:
    """Split into stretches of equal length; each ends at the first sample of the next, which it does not process."""
    N = len(flow.new)
    index = _STRETCH * np.arange(-(-N // _STRETCH)) + np.arange(_STRETCH + 1)[:, None]
    there = index < N
    own = there.copy()
    own[-1] = False
    return replace(_gathered(flow, np.minimum(index, N - 1), there, own), inside=index[0] > 0)


def _gathered(
    flow: Flow, at: Int[np.ndarray, "L G"], there: Bool[np.ndarray, "L G"], own: Bool[np.ndarray, "L G"]
) -> FlowParts:
    """Collect stretches by the indices of their samples; each starts where a run starts.

    Args:
        flow: the whole flow.
        at: (L, G), indices of the samples.
        there: (L, G), whether a stretch extends to a sample.
        own: (L, G), whether it processes the sample.
    """
    step, gone = np.minimum(at[:-1], len(flow.new) - 2), there[1:]
    counts = np.where(own[..., None], flow.counts[at], 0.0)
    return FlowParts(
        np.where(gone[..., None, None], flow.transition[step], 0.0),
        np.where(gone[..., None, None], flow.noise_input[step], 0.0),
        flow.seen[at],
        flow.new[at],
        np.where(gone[..., None], flow.shift[step], 0.0),
        np.where(gone, flow.step[step], 0.0),
        counts,
        counts,
        np.zeros(at.shape[1], dtype=bool),
        flow.spread,
    )


def _first_starts(flow: Flow, models: FilterModels) -> FilterStart:
    """First starts of the stretches: undisturbed states by their transitions, the others on the trajectory."""
    path = _uncorrected_path(flow)[::_STRETCH]
    reached = _disturbed_states(flow, models)
    inside = (np.arange(len(path)) > 0)[:, None, None]
    start = start_of(np.where(inside & reached, flow.spread, 0.0), models)
    state = start.state.copy()
    state[..., : path.shape[1]] = np.where(reached, 0.0, path[:, None])
    return replace(start, state=state)


def _disturbed_states(flow: Flow, models: FilterModels) -> Bool[np.ndarray, "B n"]:
    """States that a model's process noise moves, directly or through other states, (B, n)."""
    p = flow.rates
    disturbed = models.white > 0
    for place, size in zip(models.place.T, models.size.T, strict=True):
        disturbed |= (np.arange(p) == place[:, None]) & (size > 0)[:, None]
    reached = disturbed @ flow.noise_input.any(0).T.astype(float) > 0
    carries = flow.transition.any(0).astype(float)
    for _ in range(carries.shape[0]):
        reached |= reached @ carries.T > 0
    return reached


def _uncorrected_path(flow: Flow) -> Float[np.ndarray, "N n"]:
    """The states without corrections, relative to the trajectory, (N, n)."""
    path = np.zeros((len(flow.new), flow.transition.shape[1]))
    if flow.shift.any():
        for row, (carry, shift) in enumerate(zip(flow.transition, flow.shift, strict=True)):
            path[row + 1] = carry @ path[row] - shift
    return path


def _without_process_noise(flow: Flow, models: FilterModels) -> Filtered:
    """Innovations without disturbances: the states are known exactly and never corrected."""
    path, B = _uncorrected_path(flow), len(models)
    new = flow.new - np.einsum("kmn,kn->km", flow.seen, path)
    standard = new[:, None, None] / models.sensor
    state = np.broadcast_to(path[:, None, None], (len(path), 1, B, path.shape[1]))
    covariance = np.zeros((*state.shape, path.shape[1]))
    log_spread = np.broadcast_to(np.log(models.sensor), standard.shape)
    return Filtered(standard, log_spread, covariance, state, state, covariance)


def _next_starts(start: FilterStart, end: FilterEnd) -> FilterStart:
    """Newton step: each stretch starts at the linearly corrected end of the stretch before."""
    states, covariances = [start.state[0]], [start.covariance[0]]
    for g, kept in enumerate(end.kept[:-1]):
        moved = states[-1] - start.state[g]
        states.append(end.state[g] + (kept @ moved[..., None])[..., 0])
        covariances.append(end.covariance[g] + kept @ (covariances[-1] - start.covariance[g]) @ kept.swapaxes(-1, -2))
    return FilterStart(np.stack(states), np.stack(covariances))


def _starts_agree(start: FilterStart, end: FilterEnd) -> bool:
    """Whether each stretch starts at the end of the stretch before."""
    state, covariance = end.state[:-1], end.covariance[:-1]
    size = np.sqrt(np.maximum(covariance.diagonal(axis1=-2, axis2=-1), 0.0))
    near = np.abs(start.state[1:] - state) <= _AGREEMENT * (size + np.abs(state))
    alike = np.abs(start.covariance[1:] - covariance) <= _AGREEMENT * size[..., :, None] * size[..., None, :]
    return bool(near.all() and alike.all())


def _concatenated(found: Filtered, N: int) -> Filtered:
    """Concatenate the stretches to N samples."""

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
