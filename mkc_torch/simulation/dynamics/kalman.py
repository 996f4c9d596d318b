"""Kalman filters for many noise models at once, along one linearised trajectory.

A model has process noise of the rates, white or correlated in time, and white noise and drift of the outputs. States
start on the trajectory. Outputs are processed sequentially, which needs no matrix inverse (Anderson & Moore,
"Optimal Filtering", 1979, 6.4). Innovations beyond a limit are clipped to it before they correct the states.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from mkc_torch.simulation.dynamics.loops.kalman_filter import filter_samples
from mkc_torch.simulation.dynamics.loops.machine_code import machine_code

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_CLIP = 4.0
"""Standard deviations at which an innovation is clipped."""

OUTLIERS = 0.05
"""Share of outliers among the innovations."""

_SCALINGS = 100
"""Iterations of the profiled scale at most."""

_SETTLED = 1e-9
"""Relative change of the scale at which its iteration has converged."""

_LEAST_SCALE = 1e-150
"""Smallest scale, whose square is a positive number: innovations can all be 0."""

_LINEAR = 0.95
"""Ratio of successive steps of the scale up to which the next are extrapolated."""

_FAR = 700.0
"""Nats at which an exponent is clipped, so that its exponential does not overflow."""

_REACH = 20.0
"""Smallest range of the outliers' uniform density, in robust standard deviations."""

_LOST = 1e100
"""Largest absolute standardised innovation; its square is finite."""


@dataclass(frozen=True, eq=False)
class Flow:
    """A trajectory, linearised from sample to sample.

    Attributes:
        transition: (N-1, n, n), derivative of the states at the next sample by the states just after this sample; 0
            where a run ends.
        noise_input: (N-1, n, p), derivative of the states at the next sample by a constant disturbance of each of p
            rates in between.
        seen: (N, m, n), derivative of the outputs by the states.
        new: (N, m), recording minus outputs of the trajectory.
        shift: (N-1, n), change of the trajectory until the next sample beyond the transition of its states.
        step: (N-1,), time to the next sample in s; 0 where a run ends.
        counts: (N, m), the mask: 0 where a sample has no weight.
        spread: (n,), standard deviation of each state where a filter starts within the trajectory.
    """

    transition: Float[np.ndarray, "N-1 n n"]
    noise_input: Float[np.ndarray, "N-1 n p"]
    seen: Float[np.ndarray, "N m n"]
    new: Float[np.ndarray, "N m"]
    shift: Float[np.ndarray, "N-1 n"]
    step: Float[np.ndarray, " N-1"]
    counts: Float[np.ndarray, "N m"]
    spread: Float[np.ndarray, " n"]

    @property
    def rates(self) -> int:
        return self.noise_input.shape[-1]

    @cached_property
    def reach(self) -> Float[np.ndarray, " m"]:
        """Range of the outliers of each output, (m,): the largest distance of a sample from the trajectory."""
        away = np.where(self.counts > 0, np.abs(self.new), 0.0)
        used = [distances[counted > 0] for distances, counted in zip(away.T, self.counts.T, strict=True)]
        usual = [_REACH * float(np.median(distances)) / 0.6745 if len(distances) else 0.0 for distances in used]
        return np.maximum(np.maximum(away.max(0), usual), 1e-300)

    def in_parts(self, length: int, before: int, most: int | None = None) -> FlowParts:
        """Split into stretches, each preceded by samples in which a filter converges.

        Args:
            length: samples of a stretch.
            before: samples before a stretch.
            most: number of stretches at most; if there are more, an evenly spread subset of this size.
        """
        N = len(self.new)
        count = max(N // max(length, 1), 1)
        edges = np.linspace(0, N, count + 1).astype(int)
        own = int(np.diff(edges).max())
        first, last = edges[:-1], edges[1:] - 1
        if most is not None and count > most:
            taken = np.linspace(0, count - 1, most).astype(int)
            first, last = first[taken], last[taken]
        index = np.maximum(last[None, :] - (own + before - 1) + np.arange(own + before)[:, None], 0)
        reached = last[None, :] - (own + before - 1) + np.arange(own + before)[:, None] >= 0
        mine = (index >= first[None, :]) & reached
        step = np.maximum(index[1:] - 1, 0)
        gone = reached[:-1]
        return FlowParts(
            np.where(gone[..., None, None], self.transition[step], 0.0),
            np.where(gone[..., None, None], self.noise_input[step], 0.0),
            self.seen[index],
            self.new[index],
            np.where(gone[..., None], self.shift[step], 0.0),
            np.where(gone, self.step[step], 0.0),
            np.where(reached[..., None], self.counts[index], 0.0),
            np.where(mine[..., None], self.counts[index], 0.0),
            (last + 1 - own - before) > 0,
            self.spread,
        )

    @property
    def whole(self) -> FlowParts:
        """The flow as one stretch."""
        return self.in_parts(len(self.new), 0)


@dataclass(frozen=True)
class FlowParts:
    """G stretches of a flow, filtered in parallel: its arrays with a second dimension for the stretches.

    Attributes:
        transition, noise_input, seen, new, shift, step, counts: as in :class:`Flow`.
        mine: (L, G, m), the mask of the stretch's own samples, without those before it.
        inside: (G,), whether a stretch starts within the flow, where its states are uncertain.
        spread: (n,), standard deviation of the states at such a start.
    """

    transition: np.ndarray
    noise_input: np.ndarray
    seen: np.ndarray
    new: np.ndarray
    shift: np.ndarray
    step: np.ndarray
    counts: np.ndarray
    mine: np.ndarray
    inside: np.ndarray
    spread: np.ndarray


@dataclass(frozen=True)
class FilterModels:
    """B noise models with D lasting (time-correlated) disturbances each.

    Attributes:
        white: (B, p), standard deviation of each rate's white process noise.
        place: (B, D), where a lasting disturbance acts: the index of a rate, or p plus the index of an output.
        size: (B, D), standard deviation of a lasting disturbance.
        lasting: (B, D), its time constant in s.
        sensor: (B, m), standard deviation of each output's white noise.
        hard_clip: whether innovations below the limit pass unchanged. Otherwise they are clipped smoothly by a
            hyperbolic tangent, as in an observer, and the most likely process noise is a few per cent too large.
    """

    white: Float[np.ndarray, "B p"]
    place: Int[np.ndarray, "B D"]
    size: Float[np.ndarray, "B D"]
    lasting: Float[np.ndarray, "B D"]
    sensor: Float[np.ndarray, "B m"]
    hard_clip: bool = False

    def __len__(self) -> int:
        return len(self.white)

    def part(self, rows: slice) -> FilterModels:
        """The models in these rows."""
        arrays = (self.white, self.place, self.size, self.lasting, self.sensor)
        white, place, size, lasting, sensor = (array[rows] for array in arrays)
        return FilterModels(white, place, size, lasting, sensor, self.hard_clip)


@dataclass(frozen=True)
class FilterStart:
    """Mean and covariance of the states and lasting disturbances at the first sample of each stretch."""

    state: Float[np.ndarray, "G B k"]
    covariance: Float[np.ndarray, "G B k k"]


@dataclass(frozen=True)
class FilterEnd(FilterStart):
    """Mean and covariance after the last sample of each stretch.

    Attributes:
        kept: (G, B, k, k), derivative of the error there by an error of the state before the first sample.
    """

    kept: Float[np.ndarray, "G B k k"]


@dataclass(frozen=True)
class Filtered:
    """Innovations of the filters, and their covariances and states at each sample if kept.

    Attributes:
        standard: (L, G, B, m), innovations divided by their standard deviations.
        log_spread: (L, G, B, m), logarithms of these standard deviations.
        prior, state: covariances (L, G, B, k, k) and means (L, G, B, k) before each sample is processed; empty if not
            kept.
        posterior, after: the same after each sample.
    """

    standard: Float[np.ndarray, "L G B m"]
    log_spread: Float[np.ndarray, "L G B m"]
    prior: Float[np.ndarray, "L G B k k"]
    state: Float[np.ndarray, "L G B k"]
    after: Float[np.ndarray, "L G B k"]
    posterior: Float[np.ndarray, "L G B k k"]


def start_of(spread: Float[np.ndarray, "G B n"], models: FilterModels) -> FilterStart:
    """Start of the filters: states on the trajectory with this spread, disturbances with their prior variance."""
    G, B, n = spread.shape
    D = models.place.shape[1]
    P = np.zeros((G, B, n + D, n + D))
    own, index = np.arange(n), n + np.arange(D)
    P[..., own, own] = spread**2
    P[..., index, index] = models.size**2
    return FilterStart(np.zeros((G, B, n + D)), P)


def filtered(flow: FlowParts, models: FilterModels, *, keep: bool = False) -> Filtered:
    """Filter the stretches; ``keep`` returns covariances and states too."""
    return run_filter(flow, models, keep=keep)[0]


def run_filter(
    flow: FlowParts, models: FilterModels, *, keep: bool = False, start: FilterStart | None = None
) -> tuple[Filtered, FilterEnd]:
    """Filter the stretches, and return the states after the last sample of each too.

    Args:
        flow: the stretches.
        models: the noise models.
        keep: whether covariances and states at each sample are kept.
        start: state at the start of each stretch. None starts on the trajectory, with ``flow.spread`` inside the flow,
            and does not compute ``kept``.
    """
    if start is None:
        begins = np.where(flow.inside[:, None, None], flow.spread, np.zeros((len(models), 1)))
        found, end = _run(flow, models, start_of(begins, models), keep=keep, through=False)
        return found, end
    return _run(flow, models, start, keep=keep, through=True)


def _run(
    flow: FlowParts, models: FilterModels, start: FilterStart, *, keep: bool, through: bool
) -> tuple[Filtered, FilterEnd]:
    N, G, m = flow.new.shape
    B, k = len(models), start.state.shape[-1]
    step = flow.step[:, :, None, None]
    phi = np.where(step > 0, np.exp(-step / models.lasting), 0.0)
    renewed = models.size**2 * (1.0 - phi**2)
    kept = (N, G, B, k, k) if keep else (0, G, B, k, k)
    found = Filtered(
        np.empty((N, G, B, m)), np.empty((N, G, B, m)), np.empty(kept), np.empty(kept[:4]), np.empty(kept[:4]),
        np.empty(kept),
    )  # fmt: skip
    compiled = machine_code(filter_samples)
    if compiled is None:
        end = _sample_by_sample(flow, models, start, phi, renewed, found, keep=keep, through=through)
    else:
        end = FilterEnd(start.state.copy(), start.covariance.copy(), np.tile(np.eye(k), (G if through else 0, B, 1, 1)))
        whole = [
            flow.transition, flow.noise_input, flow.shift, phi, renewed, flow.seen, flow.new, flow.counts, models.white,
            models.place, models.sensor**2,
        ]  # fmt: skip
        compiled(
            *[np.ascontiguousarray(array) for array in whole], _CLIP, models.hard_clip, end.state, end.covariance,
            end.kept, found.standard, found.log_spread, found.prior, found.state, found.after, found.posterior,
        )  # fmt: skip
    np.log(found.log_spread, out=found.log_spread)
    return found, end


def _sample_by_sample(
    flow: FlowParts,
    models: FilterModels,
    start: FilterStart,
    phi: Float[np.ndarray, "L-1 G B D"],
    renewed: Float[np.ndarray, "L-1 G B D"],
    found: Filtered,
    *,
    keep: bool,
    through: bool,
) -> FilterEnd:
    """Do the same as :func:`filter_samples`, for all stretches and models at once in NumPy; writes into ``found``."""
    N, G, m = flow.new.shape
    n, p, B = flow.transition.shape[2], flow.noise_input.shape[-1], len(models)
    D = models.place.shape[1]
    k = n + D
    # a disturbance acts on its own rate only
    acts = np.where((models.place < p)[:, None], np.arange(p)[:, None] == models.place[:, None], 0.0)  # (B, p, D)
    C = np.zeros((G, B, m, k))
    for j in range(m):
        C[:, :, j, n:] = models.place == p + j
    state, P = start.state, start.covariance
    index = n + np.arange(D)
    variance = models.sensor**2
    A = np.zeros((G, B, k, k))
    whitened = bool(models.white.any())
    left = np.broadcast_to(np.eye(k), P.shape)
    for row in range(N):
        if row:
            A[..., :n, :n] = flow.transition[row - 1][:, None]
            noise_input = flow.noise_input[row - 1][:, None]
            if D:
                A[..., :n, n:] = noise_input @ acts
                A[..., index, index] = phi[row - 1]
            state = (A @ state[..., None])[..., 0]
            state[..., :n] -= flow.shift[row - 1][:, None]
            P = A @ P @ A.swapaxes(2, 3)
            if through:
                left = A @ left
            if D:
                P[..., index, index] += renewed[row - 1]
            if whitened:
                white = noise_input * models.white[:, None, :]
                P[..., :n, :n] += white @ white.swapaxes(2, 3)
        C[..., :n] = flow.seen[row][:, None]
        if keep:
            found.prior[row], found.state[row] = P, state
        for j in range(m):
            c = C[:, :, j]
            Pc = (P @ c[..., None])[..., 0]
            S = (c * Pc).sum(-1) + variance[:, j]
            root = np.sqrt(np.maximum(S, 1e-300))
            z = (flow.new[row, :, j, None] - (c * state).sum(-1)) / root
            found.standard[row, :, :, j], found.log_spread[row, :, :, j] = z, root
            used = flow.counts[row, :, j, None]
            pulled = used * (np.clip(z, -_CLIP, _CLIP) if models.hard_clip else _CLIP * np.tanh(z / _CLIP)) / root
            state = state + Pc * pulled[..., None]
            gain = (used / S)[..., None] * Pc
            P = P - gain[..., None] * Pc[..., None, :]
            if through:
                left = left - gain[..., None] * (c[..., None, :] @ left)
        if keep:
            found.after[row], found.posterior[row] = state, P
    return FilterEnd(state, P, left)


def robust_likelihood(
    found: Filtered,
    counts: Float[np.ndarray, "L G m"],
    reach: Float[np.ndarray, " m"],
    *,
    free: bool = True,
    least: Float[np.ndarray, " B"] | float = 0.0,
) -> tuple[Float[np.ndarray, " B"], Float[np.ndarray, " B"]]:
    """Log-likelihood of each model with outliers among the innovations, and its scale: profiled, or 1; (B,) each.

    An innovation is normal, or uniform within the reach of its output under every model. So outliers, even a burst of
    them, favour no model. (A contaminated normal density: Tukey 1960; Huber, "Robust Statistics", 1981, 1.1.)

    Args:
        found: the innovations.
        counts: (L, G, m), mask of the innovations.
        reach: (m,), range of the outliers' uniform density.
        free: whether the scale is profiled.
        least: smallest profiled scale of each model.
    """
    B = found.standard.shape[2]
    used = counts > 0
    # a model that loses the recording has innovations whose squares are infinite
    square = np.square(np.clip(found.standard.swapaxes(2, 3)[used].T, -_LOST, _LOST))  # (B, samples that count)
    spread = found.log_spread.swapaxes(2, 3)[used].T
    tail = math.log(math.sqrt(0.5 * math.pi) * OUTLIERS / (1.0 - OUTLIERS)) - np.log(reach)
    # log ratio of the outliers' density to the normal density at its mode
    odds = np.broadcast_to(tail, counts.shape)[used] + spread
    scale = np.maximum(np.sqrt(np.median(square, -1)) / 0.6745, _LEAST_SCALE) if free else np.ones(B)
    left = np.arange(B if free else 0)  # models whose scale has not converged
    moved = np.zeros(B)  # logarithm of a scale's last step; 0 after an extrapolation
    for _ in range(_SCALINGS):
        if not len(left):
            break
        own, before = square if len(left) == B else square[left], scale[left]
        away = odds if len(left) == B else odds[left]
        away = own * (0.5 / before**2)[:, None] + away
        away += np.log(before)[:, None]
        np.minimum(away, _FAR, out=away)
        np.exp(away, out=away)
        away += 1.0
        inner = np.reciprocal(away, out=away)
        step = np.log(np.sqrt(np.maximum(np.einsum("bn,bn->b", inner, own) / inner.sum(-1), 1e-300)) / before)
        # Aitken's extrapolation of linear convergence
        ratio = np.divide(step, moved[left], out=np.zeros(len(left)), where=moved[left] != 0.0)
        ratio = np.where((ratio > 0.0) & (ratio < _LINEAR), ratio, 0.0)
        scale[left] = np.maximum(before * np.exp(step / (1.0 - ratio)), _LEAST_SCALE)
        moved[left] = np.where(ratio > 0.0, 0.0, step)
        left = left[~(np.abs(step) < _SETTLED)]
    scale = np.maximum(scale, least) if free else scale
    log = np.log(scale)[:, None]
    normal = -0.5 * square / scale[:, None] ** 2 - log - spread
    return np.logaddexp(normal, odds - spread).sum(-1), scale


def smoothed(
    flow: Flow, models: FilterModels, found: Filtered
) -> tuple[Float[np.ndarray, "N k"], Float[np.ndarray, "N k k"]]:
    """Mean and covariance of the first model's states and lasting disturbances given all samples (RTS smoother).

    Rauch, Tung & Striebel, AIAA Journal 3 (1965), 1445.
    """
    N, n, p = len(flow.new), flow.transition.shape[1], flow.rates
    D = models.place.shape[1]
    state, P = found.after[:, 0, 0].copy(), found.posterior[:, 0, 0].copy()
    for row in range(N - 2, -1, -1):
        step = flow.step[row]
        if step <= 0:
            continue
        A = np.zeros((n + D, n + D))
        A[:n, :n] = flow.transition[row]
        for d in range(D):
            place = models.place[0, d]
            if place < p:
                A[:n, n + d] = flow.noise_input[row][:, place]
            A[n + d, n + d] = np.exp(-step / models.lasting[0, d])
        prior, at = found.prior[row + 1, 0, 0], found.state[row + 1, 0, 0]
        scale = 1.0 / np.sqrt(np.maximum(prior.diagonal(), 1e-300))
        inverse = np.linalg.pinv(prior * scale[:, None] * scale, rcond=1e-10, hermitian=True) * scale[:, None] * scale
        back = found.posterior[row, 0, 0] @ A.T @ inverse
        state[row] = found.after[row, 0, 0] + back @ (state[row + 1] - at)
        P[row] = found.posterior[row, 0, 0] + back @ (P[row + 1] - prior) @ back.T
    return state, P
