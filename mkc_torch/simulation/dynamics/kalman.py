"""Kalman filters for many models of the noise at once, along one linearised trajectory.

Each model pushes rates, white or for a while, and adds to the outputs' white noise an own slow part; states begin where
the simulation says. Outputs are taken up one after the other, which needs no inverse (Anderson & Moore, "Optimal
Filtering", 1979, 6.4), and an innovation far outside of its distribution moves the states as one at its edge does.
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

__all__ = [
    "FilterEnd",
    "FilterStart",
    "Filtered",
    "Flow",
    "Models",
    "Parts",
    "filtered",
    "robust_likelihood",
    "run",
    "smoothed",
    "start_of",
]

_CLIP = 4.0
"""Standard deviations beyond which an innovation moves the states no further; one within moves them as it is, so that
of normal noise the likeliest size is the true one."""
_OUTLIERS = 0.05
"""Share of the innovations that may be anywhere."""

_SCALINGS = 100
_SETTLED = 1e-9
"""Share of a scale by which its last step moved it, at most."""

_FAR = 700.0
"""Nats beyond which an exponential is none."""

_REACH = 20.0
"""Robust standard deviations within which an outlier may be at least."""


@dataclass(frozen=True, eq=False)
class Flow:
    """A trajectory, linearised from sample to sample.

    Attributes:
        carried: (N-1, n, n), the states at the next sample by those just after this one; 0 where a run ends.
        pushed: (N-1, n, p), the same by a constant push of each of p rates in between.
        seen: (N, m, n), outputs by states.
        new: (N, m), recording less what the trajectory's states give.
        shift: (N-1, n), by how much more than its own states the trajectory had moved at the next sample.
        step: (N-1,), in s.
        counts: (N, m), 0 where a sample does not count.
        spread: (n,), by how much each state may be off where one begins within the trajectory.
    """

    carried: Float[np.ndarray, "N-1 n n"]
    pushed: Float[np.ndarray, "N-1 n p"]
    seen: Float[np.ndarray, "N m n"]
    new: Float[np.ndarray, "N m"]
    shift: Float[np.ndarray, "N-1 n"]
    step: Float[np.ndarray, " N-1"]
    counts: Float[np.ndarray, "N m"]
    spread: Float[np.ndarray, " n"]

    @property
    def rates(self) -> int:
        return self.pushed.shape[-1]

    @cached_property
    def reach(self) -> Float[np.ndarray, " m"]:
        """How far outliers of each output may be from the trajectory: as far as any of its samples."""
        away = np.where(self.counts > 0, np.abs(self.new), 0.0)
        used = [one[on > 0] for one, on in zip(away.T, self.counts.T, strict=True)]
        usual = [_REACH * float(np.median(one)) / 0.6745 if len(one) else 0.0 for one in used]
        return np.maximum(np.maximum(away.max(0), usual), 1e-300)

    def in_parts(self, length: int, before: int, most: int | None = None) -> Parts:
        """Stretches of so many samples, each with some before it in which a filter finds its way.

        Args:
            length: samples of a stretch.
            before: samples before it.
            most: stretches; where there are more, so many of them, spread over the whole.
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
        return Parts(
            np.where(gone[..., None, None], self.carried[step], 0.0),
            np.where(gone[..., None, None], self.pushed[step], 0.0),
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
    def whole(self) -> Parts:
        """In one stretch."""
        return self.in_parts(len(self.new), 0)


@dataclass(frozen=True)
class Parts:
    """Stretches of a flow side by side: its arrays with a second dimension, of the G stretches.

    Attributes:
        carried, pushed, seen, new, shift, step, counts: as a flow has them.
        mine: (L, G, m), what counts of a stretch's own samples.
        inside: (G,), whether it begins within the flow, where its states are not known.
        spread: (n,), by how much they are not.
    """

    carried: np.ndarray
    pushed: np.ndarray
    seen: np.ndarray
    new: np.ndarray
    shift: np.ndarray
    step: np.ndarray
    counts: np.ndarray
    mine: np.ndarray
    inside: np.ndarray
    spread: np.ndarray


@dataclass(frozen=True)
class Models:
    """B models of the noise with D lasting disturbances each.

    Attributes:
        white: (B, p), standard deviation of a push of each rate that is new at each sample.
        place: (B, D), what a lasting disturbance acts on: a rate, or p and more for an output.
        size: (B, D), its standard deviation.
        lasting: (B, D), its time constant in s.
        sensor: (B, m), standard deviation of each output's white noise.
    """

    white: Float[np.ndarray, "B p"]
    place: Int[np.ndarray, "B D"]
    size: Float[np.ndarray, "B D"]
    lasting: Float[np.ndarray, "B D"]
    sensor: Float[np.ndarray, "B m"]

    def __len__(self) -> int:
        return len(self.white)

    def part(self, rows: slice) -> Models:
        """Some of them."""
        return Models(self.white[rows], self.place[rows], self.size[rows], self.lasting[rows], self.sensor[rows])


@dataclass(frozen=True)
class FilterStart:
    """What is known at one end of each stretch: states and lasting disturbances, and their covariance."""

    state: Float[np.ndarray, "G B k"]
    covariance: Float[np.ndarray, "G B k k"]


@dataclass(frozen=True)
class FilterEnd(FilterStart):
    """What is known after the last sample of each stretch.

    Attributes:
        kept: what is left there of an error of the state before the first sample.
    """

    kept: Float[np.ndarray, "G B k k"]


@dataclass(frozen=True)
class Filtered:
    """What a filter leaves: standardised innovations of each stretch, and covariances and states on its way if kept.

    Attributes:
        standard, log_spread: (L, G, B, m), of the innovations; the logarithm of what they were divided by.
        prior, state: before each sample is taken up, covariances (L, G, B, k, k) and means (L, G, B, k), if kept.
        posterior, after: the same after it.
    """

    standard: Float[np.ndarray, "L G B m"]
    log_spread: Float[np.ndarray, "L G B m"]
    prior: Float[np.ndarray, "L G B k k"]
    state: Float[np.ndarray, "L G B k"]
    after: Float[np.ndarray, "L G B k"]
    posterior: Float[np.ndarray, "L G B k k"]


def start_of(spread: Float[np.ndarray, "G B n"], models: Models) -> FilterStart:
    """States about where the trajectory has them, and disturbances as they are without any sample."""
    G, B, n = spread.shape
    D = models.place.shape[1]
    P = np.zeros((G, B, n + D, n + D))
    own, index = np.arange(n), n + np.arange(D)
    P[..., own, own] = spread**2
    P[..., index, index] = models.size**2
    return FilterStart(np.zeros((G, B, n + D)), P)


def filtered(flow: Parts, models: Models, *, keep: bool = False) -> Filtered:
    """What the filters leave; ``keep`` for covariances and states too."""
    return run(flow, models, keep=keep)[0]


def run(
    flow: Parts, models: Models, *, keep: bool = False, start: FilterStart | None = None
) -> tuple[Filtered, FilterEnd]:
    """What the filters leave, and what is known after the last sample of each stretch.

    Args:
        flow: stretches.
        models: of the noise.
        keep: whether covariances and states on the way are kept.
        start: what each stretch begins with; None where one that begins inside knows nothing of the samples before,
            and nobody asks what is left of it.
    """
    if start is None:
        begins = np.where(flow.inside[:, None, None], flow.spread, np.zeros((len(models), 1)))
        found, end = _run(flow, models, start_of(begins, models), keep=keep, through=False)
        return found, end
    return _run(flow, models, start, keep=keep, through=True)


def _run(flow: Parts, models: Models, start: FilterStart, *, keep: bool, through: bool) -> tuple[Filtered, FilterEnd]:
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
            flow.carried, flow.pushed, flow.shift, phi, renewed, flow.seen, flow.new, flow.counts, models.white,
            models.place, models.sensor**2,
        ]  # fmt: skip
        compiled(
            *[np.ascontiguousarray(one) for one in whole], _CLIP, end.state, end.covariance, end.kept,
            found.standard, found.log_spread, found.prior, found.state, found.after, found.posterior,
        )  # fmt: skip
    np.log(found.log_spread, out=found.log_spread)
    return found, end


def _sample_by_sample(
    flow: Parts,
    models: Models,
    start: FilterStart,
    phi: Float[np.ndarray, "L-1 G B D"],
    renewed: Float[np.ndarray, "L-1 G B D"],
    found: Filtered,
    *,
    keep: bool,
    through: bool,
) -> FilterEnd:
    """What :func:`filter_samples` does, all stretches and models at once in NumPy; writes into ``found``."""
    N, G, m = flow.new.shape
    n, p, B = flow.carried.shape[2], flow.pushed.shape[-1], len(models)
    D = models.place.shape[1]
    k = n + D
    # a disturbance pushes its rate alone
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
            A[..., :n, :n] = flow.carried[row - 1][:, None]
            pushed = flow.pushed[row - 1][:, None]
            if D:
                A[..., :n, n:] = pushed @ acts
                A[..., index, index] = phi[row - 1]
            state = (A @ state[..., None])[..., 0]
            state[..., :n] -= flow.shift[row - 1][:, None]
            P = A @ P @ A.swapaxes(2, 3)
            if through:
                left = A @ left
            if D:
                P[..., index, index] += renewed[row - 1]
            if whitened:
                white = pushed * models.white[:, None, :]
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
            pulled = used * np.clip(z, -_CLIP, _CLIP) / root
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
    """Log-likelihood of each model with a few outliers among the innovations, and its scale: profiled out, or one.

    An innovation is normal, or anywhere within the reach of its output, whatever the model: so an outlier, or a burst
    of them, speaks for no model. (A contaminated normal density: Tukey 1960; Huber, "Robust Statistics", 1981, 1.1.)

    Args:
        found: of the filters.
        counts: which innovations count.
        reach: how far from what is predicted an outlier may be.
        free: whether the scale is profiled out.
        lower: scale of each model at least, where it is.
    """
    B = found.standard.shape[2]
    used = counts > 0
    square = np.square(found.standard.swapaxes(2, 3)[used].T)  # (B, samples that count)
    spread = found.log_spread.swapaxes(2, 3)[used].T
    tail = math.log(math.sqrt(0.5 * math.pi) * _OUTLIERS / (1.0 - _OUTLIERS)) - np.log(reach)
    # of an outlier's density over the normal one's at its middle
    odds = np.broadcast_to(tail, counts.shape)[used] + spread
    scale = np.maximum(np.sqrt(np.median(square, -1)) / 0.6745, 1e-300) if free else np.ones(B)
    for _ in range(_SCALINGS if free else 0):
        away = np.clip(odds + np.log(scale)[:, None] + 0.5 * square / scale[:, None] ** 2, None, _FAR)
        inner = 1.0 / (1.0 + np.exp(away))
        before, scale = scale, np.sqrt(np.maximum((inner * square).sum(-1) / inner.sum(-1), 1e-300))
        if np.abs(scale / before - 1.0).max() < _SETTLED:
            break
    scale = np.maximum(scale, least) if free else scale
    log = np.log(scale)[:, None]
    normal = -0.5 * square / scale[:, None] ** 2 - log - spread
    return np.logaddexp(normal, odds - spread).sum(-1), scale


def smoothed(
    flow: Flow, models: Models, found: Filtered
) -> tuple[Float[np.ndarray, "N k"], Float[np.ndarray, "N k k"]]:
    """States and lasting disturbances of the first model by all of the samples, and their covariance.

    Rauch, Tung & Striebel, AIAA Journal 3 (1965), 1445.
    """
    N, n, p = len(flow.new), flow.carried.shape[1], flow.rates
    D = models.place.shape[1]
    state, P = found.after[:, 0, 0].copy(), found.posterior[:, 0, 0].copy()
    for row in range(N - 2, -1, -1):
        step = flow.step[row]
        if step <= 0:
            continue
        A = np.zeros((n + D, n + D))
        A[:n, :n] = flow.carried[row]
        for d in range(D):
            place = models.place[0, d]
            if place < p:
                A[:n, n + d] = flow.pushed[row][:, place]
            A[n + d, n + d] = np.exp(-step / models.lasting[0, d])
        prior, at = found.prior[row + 1, 0, 0], found.state[row + 1, 0, 0]
        scale = 1.0 / np.sqrt(np.maximum(prior.diagonal(), 1e-300))
        inverse = np.linalg.pinv(prior * scale[:, None] * scale, rcond=1e-10, hermitian=True) * scale[:, None] * scale
        back = found.posterior[row, 0, 0] @ A.T @ inverse
        state[row] = found.after[row, 0, 0] + back @ (state[row + 1] - at)
        P[row] = found.posterior[row, 0, 0] + back @ (P[row + 1] - prior) @ back.T
    return state, P
