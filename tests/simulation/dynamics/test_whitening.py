"""Series whitened under noise models, against the explicit covariance of the noise."""

import numpy as np
import pytest

from mkc_torch.simulation.dynamics import whitening
from mkc_torch.simulation.dynamics.kalman import FilterModels, Flow
from mkc_torch.simulation.dynamics.whitening import (
    SeriesAlong,
    gains_of,
    joined,
    relative_to,
    whitened,
    whitened_in_blocks,
    whitened_transposed,
)

STEP = 0.1
MODELS = FilterModels(
    white=np.array([[0.0], [0.7], [0.0], [0.3]]),
    place=np.array([[0], [0], [1], [1]]),
    size=np.array([[0.0], [0.9], [1.5], [0.8]]),
    lasting=np.array([[1.0], [0.6], [0.4], [2.0]]),
    sensor=np.array([[1.0], [0.5], [0.3], [0.2]]),
)
"""White noise; white and lasting process noise; sensor drift; sensor drift with white process noise."""


def oscillator(N=60, runs=1, seed=0):
    """Return an oscillator with known states at the start of each run, and its first state measured."""
    random = np.random.default_rng(seed)
    A = np.array([[1.0, STEP], [-0.4 * STEP, 0.97]])
    transition = np.broadcast_to(A, (N - 1, 2, 2)).copy()
    noise_input = np.broadcast_to(np.array([[0.5 * STEP**2], [STEP]]), (N - 1, 2, 1)).copy()
    step = np.full(N - 1, STEP)
    for first in (N * k // runs for k in range(1, runs)):
        transition[first - 1] = noise_input[first - 1] = step[first - 1] = 0.0
    counts = (random.random((N, 1)) > 0.1).astype(float)
    seen = np.broadcast_to(np.array([[1.0, 0.0]]), (N, 1, 2)).copy()
    return Flow(
        transition, noise_input, seen, random.normal(size=(N, 1)), np.zeros((N - 1, 2)), step, counts, np.ones(2)
    )


def covariance(flow, number):
    """Covariance of the outputs' noise, by the responses to each of its random numbers."""
    N, models = len(flow.new), MODELS
    responses = [models.sensor[number, 0] * np.eye(N)]
    lasting, size, place = models.lasting[number, 0], models.size[number, 0], models.place[number, 0]
    phi = np.where(flow.step > 0, np.exp(-flow.step / lasting), 0.0)
    for kind in ("lasting", "white"):
        for born in range(N):
            state, value, out = np.zeros(2), 0.0, np.zeros(N)
            for row in range(born, N):
                if row > born:
                    at_rate = value if kind == "white" or place == 0 else 0.0
                    state = flow.transition[row - 1] @ state + flow.noise_input[row - 1][:, 0] * at_rate
                    value = phi[row - 1] * value if kind == "lasting" else 0.0
                if row == born:
                    first = born == 0 or phi[born - 1] == 0.0
                    new = size if first else size * np.sqrt(1.0 - phi[born - 1] ** 2)
                    value = new if kind == "lasting" else models.white[number, 0]
                out[row] = state[0] + (value if kind == "lasting" and place == 1 else 0.0)
            responses.append(out[:, None])
    return sum(response @ response.T for response in responses)


@pytest.mark.parametrize("runs", [1, 3])
@pytest.mark.parametrize("number", range(4))
def test_whitened_series_have_the_likelihood_of_the_explicit_covariance(number, runs):
    flow = oscillator(runs=runs)
    used = flow.counts[:, 0] > 0
    S = covariance(flow, number)[np.ix_(used, used)]
    y = flow.new[used, 0]
    gains = gains_of(flow, MODELS)
    series = SeriesAlong(flow.new[..., None], np.zeros((len(flow.new) - 1, 2, 1)))
    found = dict(whitened(flow, gains, series))[number][..., 0]
    assert np.square(found).sum() == pytest.approx(y @ np.linalg.solve(S, y), rel=1e-9)
    assert gains.log_spread[number] == pytest.approx(0.5 * np.linalg.slogdet(S)[1], rel=1e-9)
    assert not found[~used].any()


def test_parallel_stretches_equal_a_single_pass(monkeypatch):
    flow = oscillator(N=200, runs=2)
    gains = gains_of(flow, MODELS)
    random = np.random.default_rng(1)
    series = SeriesAlong(random.normal(size=(200, 1, 5)), 0.1 * random.normal(size=(199, 2, 5)))
    whole = dict(whitened(flow, gains, series))
    monkeypatch.setattr(whitening, "_WHOLE", 10)
    monkeypatch.setattr(whitening, "_STRETCH", 37)
    for number, values in whitened(flow, gains, series):
        np.testing.assert_allclose(values, whole[number], atol=1e-10)


@pytest.mark.parametrize("number", range(1, 4))
def test_relative_to_inverts_whitening(number):
    flow = oscillator(runs=2)
    models = MODELS.part(slice(number, number + 1))
    gains = gains_of(flow, models)
    innovations = np.random.default_rng(2).normal(size=(60, 1, 3)) * flow.counts[..., None]
    spread = np.where(flow.counts > 0, gains.white[:, 0, :, 0], 1.0)
    series = relative_to(flow, gains.gain[:, 0], models.place[0], models.lasting[0], innovations / spread[..., None])
    [(_, found)] = whitened(flow, gains, series)
    np.testing.assert_allclose(found, innovations, atol=1e-10)


def test_series_in_a_batch_are_independent():
    flow = oscillator()
    gains = gains_of(flow, MODELS)
    random = np.random.default_rng(3)
    first, second = (SeriesAlong(random.normal(size=(60, 1, 2)), random.normal(size=(59, 2, 2))) for _ in range(2))
    alone, both = dict(whitened(flow, gains, first)), dict(whitened(flow, gains, joined(first, second)))
    for number, values in alone.items():
        np.testing.assert_allclose(both[number][..., :2], values, atol=1e-12)


@pytest.mark.parametrize("way", ["machine code", "NumPy"])
@pytest.mark.parametrize("length", [1, 33, 120, 500])
def test_blocks_equal_a_single_pass(length, way, monkeypatch):
    if way == "NumPy":
        monkeypatch.setattr(whitening, "machine_code", lambda _: None)
    flow = oscillator(N=120, runs=2)
    gains = gains_of(flow, MODELS)
    random = np.random.default_rng(1)
    series = SeriesAlong(random.normal(size=(120, 1, 5)), 0.1 * random.normal(size=(119, 2, 5)))
    for number, whole in whitened(flow, gains, series):
        blocks = [values.copy() for _, values in whitened_in_blocks(flow, gains, number, series, length)]
        assert len(blocks) == -(-120 // length)
        np.testing.assert_array_equal(np.concatenate(blocks), whole)


@pytest.mark.parametrize("number", range(4))
def test_products_with_innovations_equal_those_of_the_transposed_whitening(number):
    flow = oscillator(N=40, runs=2)
    gains = gains_of(flow, MODELS)
    random = np.random.default_rng(4)
    series = SeriesAlong(random.normal(size=(40, 1, 3)), random.normal(size=(39, 2, 3)))
    innovations = random.normal(size=(40, 1, 2))
    back = whitened_transposed(flow, gains, number, innovations)
    expected = np.einsum("nmk,nmy->ky", dict(whitened(flow, gains, series))[number], innovations)
    found = np.einsum("nmk,nmy->ky", series.new, back.new) + np.einsum("nik,niy->ky", series.shift, back.shift)
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)


def test_triangular_inverses_match_numpy():
    L = np.tril(np.random.default_rng(2).normal(size=(50, 3, 3))) + 4.0 * np.eye(3)
    np.testing.assert_allclose(whitening._lower_inverse(L), np.linalg.inv(L), rtol=0, atol=1e-14)
