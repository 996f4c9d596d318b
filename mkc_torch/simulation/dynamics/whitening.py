"""Whiten series along a linearised trajectory under many noise models.

A Kalman filter's gains depend on the noise model only, so one pass over its covariances whitens any number of series: a
recording, draws of noise, tangents of parameters and of candidate effects. A series is given relative to the
trajectory, with the jumps that it makes in the states, and the filter estimates the difference. So the series of an
unstable system stay finite.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mkc_torch.simulation.dynamics.kalman import FilterModels, Flow
from mkc_torch.simulation.dynamics.loops.machine_code import machine_code
from mkc_torch.simulation.dynamics.loops.whiten import whiten_samples, whiten_transposed
from mkc_torch.simulation.dynamics.parallel_filter import filtered_whole

if TYPE_CHECKING:
    from jaxtyping import Float

_CELLS = 24_000_000
"""Numbers of whitened series held in memory at once: 192 MB."""

_WHOLE = 1500
"""Samples up to which a recording is filtered in one pass; longer recordings take two over parallel stretches."""

_STRETCH = 300
"""Samples of a parallel stretch."""


@dataclass(frozen=True)
class SeriesAlong:
    """K series along a trajectory.

    Attributes:
        new: (N, m, K), additions to the outputs, given the trajectory's states.
        shift: (N-1, n, K), additions to the trajectory's states until the next sample.
    """

    new: Float[np.ndarray, "N m K"]
    shift: Float[np.ndarray, "N-1 n K"]

    @property
    def count(self) -> int:
        """Number of series."""
        return self.new.shape[-1]


@dataclass(frozen=True)
class FilterGains:
    """The Kalman filters of B noise models.

    Attributes:
        models: the models.
        gain: (N, B, k, m), of states and lasting disturbances; 0 where a sample is masked.
        white: (N, B, m, m), whitens the innovations of a sample to variance 1; 0 where a sample is masked.
        log_spread: (B,), sum of the logarithms of the innovations' standard deviations, over unmasked samples.
    """

    models: FilterModels
    gain: Float[np.ndarray, "N B k m"]
    white: Float[np.ndarray, "N B m m"]
    log_spread: Float[np.ndarray, " B"]


def joined(*series: SeriesAlong) -> SeriesAlong:
    """Concatenate series."""
    return SeriesAlong(
        np.concatenate([part.new for part in series], -1), np.concatenate([part.shift for part in series], -1)
    )


def gains_of(flow: Flow, models: FilterModels) -> FilterGains:
    """Compute the gains of Kalman filters along a flow."""
    n, D = flow.transition.shape[1], models.place.shape[1]
    N, m = flow.new.shape
    P = filtered_whole(flow, models, keep=True).prior[:, 0]
    if P.shape[1:] != (len(models), n + D, n + D):  # without process noise the states are known exactly
        P = np.zeros((N, len(models), n + D, n + D))
    C = _seen(flow, models)
    cross = P @ C.swapaxes(-1, -2)
    variance = models.sensor[:, :, None] ** 2 * np.eye(m)
    S = C @ cross + variance
    used = flow.counts > 0
    # masked outputs of a sample take no part in its whitening
    both = used[:, None, :, None] & used[:, None, None, :]
    S = np.where(both, S, np.eye(m))
    cross = cross * used[:, None, None, :]
    gain = np.linalg.solve(S, cross.swapaxes(-1, -2)).swapaxes(-1, -2)
    L = np.linalg.cholesky(S)
    white = _lower_inverse(L) * used[:, None, :, None]
    spread = np.log(np.diagonal(L, axis1=-2, axis2=-1)) * used[:, None]
    return FilterGains(models, gain, white, spread.sum((0, 2)))


def _lower_inverse(L: Float[np.ndarray, "*b m m"]) -> Float[np.ndarray, "*b m m"]:
    """Invert a batch of lower triangular matrices by forward substitution."""
    inverse = np.zeros_like(L)
    for row in range(L.shape[-1]):
        known = (L[..., row, :row, None] * inverse[..., :row, :]).sum(-2)
        inverse[..., row, :] = -known
        inverse[..., row, row] += 1.0
        inverse[..., row, :] /= L[..., row, row, None]
    return inverse


def whitened(flow: Flow, gains: FilterGains, series: SeriesAlong) -> Iterator[tuple[int, Float[np.ndarray, "N m K"]]]:
    """Whiten series under each noise model; yields the index of the model and innovations of variance 1."""
    N, m, K = series.new.shape
    B = len(gains.models)
    block = max(1, min(B, _CELLS // max(N * m * K, 1)))
    for first in range(0, B, block):
        part = slice(first, min(first + block, B))
        found = _filtered(flow, gains, part, series)
        for number in range(found.shape[1]):
            yield first + number, found[:, number]


def whitened_in_blocks(
    flow: Flow, gains: FilterGains, number: int, series: SeriesAlong, length: int
) -> Iterator[tuple[slice, Float[np.ndarray, "L m K"]]]:
    """Whiten series under one noise model, block by block; yields the samples of a block and their innovations.

    The next block overwrites the innovations of the block before.

    Args:
        flow: the linearised trajectory.
        gains: the filters of the models.
        number: index of the model.
        series: K series.
        length: samples of a block.
    """
    N, m, K = series.new.shape
    blocks = [slice(first, min(first + length, N)) for first in range(0, N, length)]
    part = slice(number, number + 1)
    compiled = machine_code(whiten_samples)
    if compiled is None:
        whole = _filtered(flow, gains, part, series)[:, 0]
        yield from ((rows, whole[rows]) for rows in blocks)
        return
    models = gains.models.part(part)
    phi = _stays(flow, models)
    gain, white = np.ascontiguousarray(gains.gain[:, part]), np.ascontiguousarray(gains.white[:, part])
    start = np.zeros((1, gain.shape[2], K))
    out = np.empty((1, min(length, N), m, K))
    for rows in blocks:
        on = slice(rows.start, min(rows.stop, N - 1))
        here = out[:, : rows.stop - rows.start]
        compiled(
            flow.transition[on], flow.noise_input[on], phi[on], models.place, flow.seen[rows], gain[rows], white[rows],
            series.new[rows], series.shift[on], start, here,
        )  # fmt: skip
        yield rows, here[0]


def whitened_transposed(
    flow: Flow, gains: FilterGains, number: int, innovations: Float[np.ndarray, "N m K"]
) -> SeriesAlong | None:
    """Apply the transpose of the whitening under one noise model; None without Numba.

    The product of any whitened series with innovations is that of the series with the result, so that many series need
    not be whitened again.

    Args:
        flow: the linearised trajectory.
        gains: the filters of the models.
        number: index of the model.
        innovations: K series of innovations.
    """
    compiled = machine_code(whiten_transposed)
    if compiled is None:
        return None
    part = slice(number, number + 1)
    models = gains.models.part(part)
    found = SeriesAlong(
        np.empty_like(innovations), np.empty((len(flow.shift), flow.shift.shape[1], innovations.shape[2]))
    )
    known = _carried(flow, models), _seen(flow, models), gains.gain[:, part], gains.white[:, part]
    compiled(*(np.ascontiguousarray(array[:, 0]) for array in known), innovations, found.new, found.shift)
    return found


def relative_to(
    flow: Flow,
    gain: Float[np.ndarray, "N k m"],
    places: Float[np.ndarray, " D"],
    lasting: Float[np.ndarray, " D"],
    innovations: Float[np.ndarray, "N m K"],
    corrects: Float[np.ndarray, "N m"] | float = 1.0,
) -> SeriesAlong:
    """The series that have given innovations under a filter; the inverse of whitening.

    Args:
        flow: the linearised trajectory.
        gain: gains of the filter.
        places: where each of its D lasting disturbances acts: the index of a rate, or p plus the index of an output.
        lasting: their time constants in s.
        innovations: of each series.
        corrects: share of an innovation that enters the correction.
    """
    n, p, D = flow.transition.shape[1], flow.rates, len(places)
    scale = np.broadcast_to(corrects, innovations.shape[:2])[..., None]
    jump = gain @ (scale * innovations)
    new = innovations.copy()
    shift = flow.transition @ jump[:-1, :n]
    if D:
        phi = np.where(flow.step[:, None] > 0, np.exp(-flow.step[:, None] / lasting), 0.0)
        value = np.zeros((D, innovations.shape[-1]))
        for row in range(len(innovations)):
            if row:
                value = phi[row - 1][:, None] * value
            for d, place in enumerate(places):
                if place >= p:
                    new[row, int(place) - p] += value[d]
            value = value + jump[row, n:]
            if row < len(shift):
                for d, place in enumerate(places):
                    if place < p:
                        shift[row] += flow.noise_input[row][:, int(place), None] * value[d]
    return SeriesAlong(new, shift)


def _seen(flow: Flow, models: FilterModels) -> Float[np.ndarray, "N B m k"]:
    N, m, n = flow.seen.shape
    B, D = models.place.shape
    own = (models.place[:, None, :] == flow.rates + np.arange(m)[:, None]).astype(float)
    C = np.empty((N, B, m, n + D))
    C[..., :n] = flow.seen[:, None]
    C[..., n:] = own
    return C


def _filtered(flow: Flow, gains: FilterGains, part: slice, series: SeriesAlong) -> Float[np.ndarray, "N B m K"]:
    """Whiten in one stretch, or in parallel stretches: from states of 0, then from the end of the stretch before."""
    N, m, K = series.new.shape
    compiled = machine_code(whiten_samples)
    if compiled is not None:
        return _by_machine_code(compiled, flow, gains, part, series)
    count = 1 if N <= _WHOLE else -(-N // _STRETCH)
    stretches = _Stretches.of(flow, gains, part, series, count)
    B, k = stretches.carry.shape[2:4]
    start = np.zeros((count, B, k, K))
    if count > 1:
        end, passed_on = stretches.run(start)[1:]
        for g in range(count - 1):
            start[g + 1] = end[g] + passed_on[g] @ start[g]
    return stretches.run(start)[0].reshape(-1, B, m, K)[:N]


def _by_machine_code(
    compiled: Callable[..., object], flow: Flow, gains: FilterGains, part: slice, series: SeriesAlong
) -> Float[np.ndarray, "N B m K"]:
    models, (N, m, K) = gains.models.part(part), series.new.shape
    out = np.empty((len(models), N, m, K))
    start = np.zeros((len(models), gains.gain.shape[2], K))
    whole = [
        flow.transition, flow.noise_input, _stays(flow, models), models.place, flow.seen, gains.gain[:, part],
        gains.white[:, part], series.new, series.shift,
    ]  # fmt: skip
    compiled(*[np.ascontiguousarray(array) for array in whole], start, out)
    return out.swapaxes(0, 1)


def _stays(flow: Flow, models: FilterModels) -> Float[np.ndarray, "N-1 B D"]:
    """Share of each lasting disturbance that remains at the next sample."""
    step = flow.step[:, None, None]
    share: np.ndarray = np.where(step > 0, np.exp(-step / models.lasting), 0.0)
    return share


@dataclass(frozen=True)
class _Stretches:
    """G stretches of L samples under B models, with the series; the first axis is the sample within its stretch."""

    carry: Float[np.ndarray, "L G B k k"]
    seen: Float[np.ndarray, "L G B m k"]
    gain: Float[np.ndarray, "L G B k m"]
    white: Float[np.ndarray, "L G B m m"]
    new: Float[np.ndarray, "L G m K"]
    shift: Float[np.ndarray, "L G n K"]

    @classmethod
    def of(cls, flow: Flow, gains: FilterGains, part: slice, series: SeriesAlong, count: int) -> _Stretches:
        N = len(flow.new)
        models = gains.models.part(part)
        length = -(-N // count)

        def cut(values: np.ndarray) -> np.ndarray:
            more = np.zeros((length * count - len(values), *values.shape[1:]))
            return np.concatenate([values, more]).reshape(count, length, *values.shape[1:]).swapaxes(0, 1)

        return cls(
            cut(_carried(flow, models)),
            cut(_seen(flow, models)),
            cut(gains.gain[:, part]),
            cut(gains.white[:, part]),
            cut(series.new),
            cut(series.shift),
        )

    def run(
        self, start: Float[np.ndarray, "G B k K"]
    ) -> tuple[Float[np.ndarray, "G L B m K"], Float[np.ndarray, "G B k K"], Float[np.ndarray, "G B k k"]]:
        """Innovations from initial states, states after the last sample, and their derivative by the initial states."""
        L, G, B, k, _ = self.carry.shape
        m, K = self.new.shape[2:]
        n = self.shift.shape[2]
        out = np.empty((G, L, B, m, K))
        state, kept = start, np.broadcast_to(np.eye(k), (G, B, k, k))
        for row in range(L):
            left = self.new[row][:, None] - self.seen[row] @ state
            np.matmul(self.white[row], left, out=out[:, row])
            state = self.carry[row] @ (state + self.gain[row] @ left)
            state[:, :, :n] -= self.shift[row][:, None]
            if G > 1:
                kept = self.carry[row] @ (kept - self.gain[row] @ (self.seen[row] @ kept))
        return out, state, kept


def _carried(flow: Flow, models: FilterModels) -> Float[np.ndarray, "N-1 B k k"]:
    """Transition matrices of states and lasting disturbances to the next sample."""
    n, p, (B, D) = flow.transition.shape[1], flow.rates, models.place.shape
    acts = (np.arange(p)[:, None] == models.place[:, None, :]).astype(float)
    A = np.zeros((len(flow.step), B, n + D, n + D))
    A[..., :n, :n] = flow.transition[:, None]
    A[..., :n, n:] = flow.noise_input[:, None] @ acts
    index = n + np.arange(D)
    step = flow.step[:, None, None]
    A[..., index, index] = np.where(step > 0, np.exp(-step / models.lasting), 0.0)
    return A
