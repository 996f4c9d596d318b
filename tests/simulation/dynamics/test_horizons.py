"""Predictions several samples ahead, compared with a propagation sample by sample."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from mkc_torch.simulation.dynamics.draws import drawn
from mkc_torch.simulation.dynamics.horizons import horizons_of, log_likelihood_ahead, per_sample
from mkc_torch.simulation.dynamics.kalman import OUTLIERS, FilterModels, Flow
from mkc_torch.simulation.dynamics.noise_model import NoiseModel, filter_models
from mkc_torch.simulation.dynamics.parallel_filter import filtered_whole

if TYPE_CHECKING:
    from jaxtyping import Float

N, STATES, OUTPUTS = 40, 2, 2
SPAN = np.array([6.0, 5.0])


def flow(seed: int, *, restart: int | None = 22) -> Flow:
    """A random stable flow of two states, two disturbable rates and two outputs, in one run or two."""
    rng = np.random.default_rng(seed)
    transition = 0.9 * np.eye(STATES) + 0.1 * rng.normal(size=(N - 1, STATES, STATES))
    noise_input = 0.3 * rng.normal(size=(N - 1, STATES, STATES))
    shift, step = 0.1 * rng.normal(size=(N - 1, STATES)), np.full(N - 1, 0.5)
    if restart is not None:
        for array in (transition, noise_input, shift, step):
            array[restart - 1] = 0.0
    counts = (rng.random((N, OUTPUTS)) > 0.1).astype(float)
    seen, new = rng.normal(size=(N, OUTPUTS, STATES)), rng.normal(size=(N, OUTPUTS))
    return Flow(transition, noise_input, seen, new, shift, step, counts, np.ones(STATES))


NOISES = (
    NoiseModel((0.8, 0.6), ((0, 0.5, 0.0),), (True, True)),
    NoiseModel((0.8, 0.6), ((1, 0.7, 2.0), (0, 0.2, 0.0)), (True, True)),
    NoiseModel((0.8, 0.6), ((2, 0.7, 1.5),), (True, True)),
)


def one_by_one(known: Flow, noise: NoiseModel, horizon: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of each sample's outputs, propagated from the filter's state ``horizon`` samples before."""
    models: FilterModels = filter_models(known, [noise])
    found = filtered_whole(known, models, keep=True)
    D = models.place.shape[1]
    k = STATES + D
    means, covariances = np.empty((N, OUTPUTS)), np.empty((N, OUTPUTS, OUTPUTS))
    for row in range(N):
        begin = row - horizon
        if begin >= 0:
            state, P = found.after[begin, 0, 0], found.posterior[begin, 0, 0]
        else:
            state, P = np.zeros(k), np.diag([*np.zeros(STATES), *models.size[0] ** 2])
        for at in range(max(begin, 0), row):
            A, Q, b = np.zeros((k, k)), np.zeros((k, k)), np.zeros(k)
            A[:STATES, :STATES], b[:STATES] = known.transition[at], known.shift[at]
            white = known.noise_input[at] * models.white[0]
            Q[:STATES, :STATES] = white @ white.T
            for d in range(D):
                phi = math.exp(-known.step[at] / models.lasting[0, d]) if known.step[at] > 0 else 0.0
                A[STATES + d, STATES + d] = phi
                Q[STATES + d, STATES + d] = models.size[0, d] ** 2 * (1.0 - phi**2)
                if models.place[0, d] < STATES:
                    A[:STATES, STATES + d] = known.noise_input[at][:, models.place[0, d]]
            state, P = A @ state - b, A @ P @ A.T + Q
        C = np.concatenate([known.seen[row], np.zeros((OUTPUTS, D))], 1)
        for d in range(D):
            if models.place[0, d] >= STATES:
                C[models.place[0, d] - STATES, STATES + d] = 1.0
        means[row], covariances[row] = C @ state, C @ P @ C.T + np.diag(models.sensor[0] ** 2)
    return means, covariances


def density(known: Flow, means: np.ndarray, covariances: np.ndarray) -> Float[np.ndarray, " N"]:
    """Log density of each sample: a normal density, or with a small probability uniform over the span."""
    total = np.zeros(N)
    for row in range(N):
        factor = np.linalg.cholesky(covariances[row])
        z = np.linalg.solve(factor, known.new[row] - means[row])
        normal = (1.0 - OUTLIERS) * np.exp(-0.5 * z**2) / (math.sqrt(2.0 * math.pi) * factor.diagonal())
        total[row] = (known.counts[row] * np.log(normal + OUTLIERS / SPAN)).sum()
    return total


@pytest.mark.parametrize("noise", NOISES, ids=["white", "lasting and white", "drift"])
@pytest.mark.parametrize("restart", [None, 22])
def test_predictions_equal_a_propagation_sample_by_sample(noise: NoiseModel, restart: int | None) -> None:
    known, horizons = flow(3, restart=restart), (1, 4, 16, 64)  # the last is longer than the recording: the free run
    values, scales = log_likelihood_ahead(known, [noise], horizons, SPAN)
    each = [density(known, *one_by_one(known, noise, horizon)) for horizon in horizons]
    assert scales.tolist() == [1.0]  # declared noise
    np.testing.assert_allclose(values[0], [value.sum() for value in each], rtol=1e-9)
    np.testing.assert_allclose(per_sample(known, noise, horizons, SPAN), np.mean(each, 0), rtol=1e-8, atol=1e-9)


def test_white_sensor_noise_gives_the_free_run_over_every_horizon() -> None:
    known, noise = flow(4), NoiseModel((0.8, 0.6), (), (True, True))
    values, _ = log_likelihood_ahead(known, [noise], (1, 4, 16), SPAN)
    assert values[0, 0] == values[0, 1] == values[0, 2]
    path = np.zeros((N, STATES))
    for row in range(N - 1):
        path[row + 1] = known.transition[row] @ path[row] - known.shift[row]
    means = np.einsum("nms,ns->nm", known.seen, path)
    covariances = np.broadcast_to(np.diag([0.64, 0.36]), (N, 2, 2))
    assert values[0, 0] == pytest.approx(density(known, means, covariances).sum(), rel=1e-9)


@pytest.mark.parametrize("noise", NOISES, ids=["white", "lasting and white", "drift"])
def test_drawn_recordings_have_the_covariance_of_the_free_run(noise: NoiseModel) -> None:
    known = replace(flow(8), shift=np.zeros((N - 1, STATES)))
    count = 8000
    draws = drawn(known, noise, count, np.random.default_rng(0))
    assert draws.shape == (count, N, OUTPUTS)
    _, expected = one_by_one(known, noise, 64)
    found = np.einsum("bkm,bkn->kmn", draws, draws) / count
    size = np.sqrt(np.einsum("kmm->km", expected))
    # standard errors of variances of 8,000 draws are 1.6 %; five of them
    np.testing.assert_allclose(
        found / size[:, :, None] / size[:, None], expected / size[:, :, None] / size[:, None], atol=0.08
    )


def test_models_of_different_kinds_are_evaluated_together() -> None:
    known = flow(5)
    noises = (*NOISES, NoiseModel((0.8, 0.6), (), (True, True)))
    together, _ = log_likelihood_ahead(known, noises, (1, 4), SPAN)
    alone = [log_likelihood_ahead(known, [noise], (1, 4), SPAN)[0][0] for noise in noises]
    np.testing.assert_allclose(together, alone, rtol=1e-10)


def test_the_scale_of_undeclared_noise_is_the_most_likely() -> None:
    known = flow(6)
    noise = NoiseModel((0.8, 0.6), ((0, 0.5, 0.0),), (False, False))
    values, scales = log_likelihood_ahead(known, [noise], (1, 4), SPAN)

    def at(factor: float) -> float:
        scale = factor * float(scales[0])
        fixed = NoiseModel((0.8 * scale, 0.6 * scale), ((0, 0.5 * scale, 0.0),), (True, True))
        return float(log_likelihood_ahead(known, [fixed], (1, 4), SPAN)[0].mean())

    best = float(values.mean())
    # a filter clips innovations at a multiple of the noise, so it changes slightly with the scale
    assert best == pytest.approx(at(1.0), abs=0.05)
    assert best > max(at(0.8), at(1.25))


def test_horizons_reach_a_tenth_of_the_shortest_run_and_last_the_whole_of_the_longest() -> None:
    assert horizons_of(flow(0, restart=None)) == (1, 4, 64)
    assert horizons_of(flow(0, restart=22)) == (1, 32)
