"""Predictions of a flow several samples ahead, under many noise models at once.

A filter gives the states at each sample. Before a run's first h samples a prediction is the free run from its start.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from mkc_torch.simulation.dynamics.composed import Disturbances, composed, times, times_transposed, times_vector
from mkc_torch.simulation.dynamics.kalman import OUTLIERS, FilterModels, Flow, robust_likelihood
from mkc_torch.simulation.dynamics.kalman import Filtered as Innovations
from mkc_torch.simulation.dynamics.noise_model import NoiseModel, filter_models
from mkc_torch.simulation.dynamics.parallel_filter import filtered_whole

if TYPE_CHECKING:
    from jaxtyping import Float

_RATIO = 4
"""Ratio of neighbouring horizons."""

_LONGEST = 10
"""Shortest run over the longest horizon."""

_CELLS = 1 << 22
"""Numbers of the covariances that are held at once: 32 MB, a few times over."""


def horizons_of(flow: Flow) -> tuple[int, ...]:
    """The horizons 1, 4, 16, … in samples, up to a tenth of the shortest run, and last the free run of the longest."""
    ends = np.flatnonzero(np.concatenate([flow.step <= 0, [True]]))
    lengths = np.diff(np.concatenate([[-1], ends]))
    found = [1]
    while found[-1] * _RATIO <= int(lengths.min()) // _LONGEST:
        found.append(found[-1] * _RATIO)
    free = 1 << (int(lengths.max()) - 1).bit_length()  # predictions are composed by doubling
    return (*found, free) if free > found[-1] else tuple(found)


def log_likelihood_ahead(
    flow: Flow, noises: Sequence[NoiseModel], horizons: Sequence[int], span: Float[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, "B H"], Float[np.ndarray, " B"]]:
    """Log-likelihood of the recording under noise models, from predictions over each horizon, and the noise's scale.

    An innovation is normal, or with a probability of 5 % uniform over the output's span. The scale of a model's noise
    is the most likely over all horizons together; it is 1 where a sensor's noise is declared.

    Args:
        flow: the linearised trajectory; its ``counts`` mask the samples.
        noises: B models, which declare the white noise of the same outputs.
        horizons: H numbers of samples.
        span: (m,), range of each output.

    Returns:
        The log-likelihood of each horizon in nats, (B, H), and the scales, (B,).
    """
    values, scales = np.full((len(noises), len(horizons)), -np.inf), np.ones(len(noises))
    white = np.array([not noise.components for noise in noises], dtype=bool)
    states = flow.transition.shape[1] + max((len(noise.components) for noise in noises), default=0)
    block = max(1, _CELLS // (len(flow.new) * states**2))
    for kind in (True, False):
        rows = np.flatnonzero(white == kind)
        for first in range(0, len(rows), block):
            part = rows[first : first + block]
            values[part], scales[part] = _of_block(flow, [noises[row] for row in part], horizons, span)
    return values, scales


def per_sample(
    flow: Flow, noise: NoiseModel, horizons: Sequence[int], span: Float[np.ndarray, " m"]
) -> Float[np.ndarray, " N"]:
    """Log-likelihood of each sample under a noise model as it is, averaged over the horizons, in nats."""
    found = _ahead(flow, filter_models(flow, [noise]), horizons)
    normal = -0.5 * np.square(found.standard[:, :, 0]) - found.log_spread[:, :, 0]
    normal += math.log((1.0 - OUTLIERS) / math.sqrt(2.0 * math.pi))
    value = np.logaddexp(normal, np.log(OUTLIERS / span)) * flow.counts[:, None]
    result: np.ndarray = value.sum(-1).mean(1)
    return result


def _of_block(
    flow: Flow, noises: Sequence[NoiseModel], horizons: Sequence[int], span: Float[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, "B H"], Float[np.ndarray, " B"]]:
    found = _ahead(flow, filter_models(flow, noises), horizons)
    if not np.isfinite(found.standard).all():
        finite = np.isfinite(found.standard).all((0, 1, 3))
        values, scales = np.full((len(noises), len(horizons)), -np.inf), np.ones(len(noises))
        if finite.any():
            kept = [noise for noise, good in zip(noises, finite, strict=True) if good]
            values[finite], scales[finite] = _of_block(flow, kept, horizons, span)
        return values, scales
    counts = np.repeat(flow.counts[:, None], found.standard.shape[1], 1)
    least = np.array([noise.least_scale for noise in noises])
    _, scales = robust_likelihood(found, counts, 0.5 * span, free=not any(noises[0].known), least=least)
    moved = Innovations(
        found.standard / scales[:, None], found.log_spread + np.log(scales)[:, None], *[np.empty(0)] * 4
    )
    each = []
    for number in range(found.standard.shape[1]):
        one = Innovations(moved.standard[:, [number]], moved.log_spread[:, [number]], *[np.empty(0)] * 4)
        each.append(robust_likelihood(one, flow.counts[:, None], 0.5 * span, free=False)[0])
    constant = float(flow.counts.sum()) * math.log((1.0 - OUTLIERS) / math.sqrt(2.0 * math.pi))
    values = np.stack(each, -1) + constant
    return np.broadcast_to(values, (len(noises), len(horizons))), scales


def _ahead(flow: Flow, models: FilterModels, horizons: Sequence[int]) -> Innovations:
    """Innovations over each horizon in its second dimension; a single one where all are equal."""
    found = filtered_whole(flow, models, keep=True)
    empty = [np.empty(0)] * 4
    if not models.white.any() and not models.place.shape[1]:
        return Innovations(found.standard, found.log_spread, *empty)  # no correction: all horizons are the free run
    mean = np.ascontiguousarray(found.after[:, 0].transpose(2, 1, 0))
    covariance = np.ascontiguousarray(found.posterior[:, 0].transpose(2, 3, 1, 0))
    seen = np.ascontiguousarray(flow.seen.transpose(1, 2, 0))
    (m, n, N), B = seen.shape, len(models)
    kinds = Disturbances.of(models)
    standard, log_spread = [], []
    for ahead, horizon in composed(flow, kinds, horizons):
        behind = slice(0, max(N - horizon, 0))
        by_kind, noise = ahead.shown(seen, kinds.place - flow.rates)
        S = np.einsum("ijun,bu->ijbn", noise, kinds.variance)
        new = np.repeat((flow.new.T - times_vector(seen, ahead.shift))[:, None], B, 1)
        back = np.broadcast_to(times(seen, ahead.carry)[:, :, None], (m, n, B, N))
        G = np.concatenate([back, by_kind[:, kinds.slots].transpose(0, 2, 1, 3)], 1)[..., horizon:]
        new[..., horizon:] -= times_vector(G, mean[..., behind])
        S[..., horizon:] += times_transposed(times(G, covariance[..., behind]), G)
        z, log = _standardised(new, S, models.sensor.T)
        standard.append(z)
        log_spread.append(log)
    return Innovations(np.stack(standard).transpose(3, 0, 2, 1), np.stack(log_spread).transpose(3, 0, 2, 1), *empty)


def _standardised(
    new: Float[np.ndarray, "m B N"], S: Float[np.ndarray, "m m B N"], sensor: Float[np.ndarray, "m B"]
) -> tuple[Float[np.ndarray, "m B N"], Float[np.ndarray, "m B N"]]:
    """Whiten the outputs' innovations one after the other by Cholesky's factor of their covariance."""
    m = len(new)
    factor, z, log = np.zeros_like(S), np.empty_like(new), np.empty_like(new)
    for i in range(m):
        for j in range(i):
            inner = S[i, j] - (factor[i, :j] * factor[j, :j]).sum(0)
            factor[i, j] = inner / factor[j, j]
        own = S[i, i] + sensor[i, :, None] ** 2 - np.square(factor[i, :i]).sum(0)
        factor[i, i] = np.sqrt(np.maximum(own, 1e-300))
        z[i] = (new[i] - (factor[i, :i] * z[:i]).sum(0)) / factor[i, i]
        log[i] = np.log(factor[i, i])
    return z, log
