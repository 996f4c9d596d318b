"""Filters and smoothers against the joint normal distribution of all samples with its explicit covariance."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mkc_torch.simulation.dynamics import kalman
from mkc_torch.simulation.dynamics.kalman import Filtered, FilterModels, filtered, robust_likelihood, smoothed
from tests.simulation.dynamics.oscillating import course, disturbed_states, flow, with_residual

TINY = 1e-3
"""Scale of the residuals relative to the model, so small that clipping has no effect."""

TWO_OUTPUTS = ((1.0, 0.0), (0.3, 1.0))


def model(white=0.0, place=(), size=(), lasting=(), sensor=(0.1,)):
    """Return a noise model of the oscillator, with process noise of its speed."""
    return FilterModels(
        np.array([[white]]), np.array([place], dtype=int), np.array([size]), np.array([lasting]), np.array([sensor])
    )


def batch(*models):
    """Return a batch of models of the same shape."""
    parts = ((getattr(model, name) for model in models) for name in ("white", "place", "size", "lasting", "sensor"))
    return FilterModels(*(np.concatenate(list(part)) for part in parts))


MODELS = {
    "sensor alone": model(),
    "white process": model(white=2.0),
    "slow process": model(place=(0,), size=(1.5,), lasting=(0.4,)),
    "slow sensor": model(place=(1,), size=(0.3,), lasting=(0.4,)),
    "all of them": model(white=2.0, place=(1, 0), size=(0.3, 1.5), lasting=(0.4, 1.0)),
}


def responses_to_disturbances(flow):
    """Derivatives of the residuals by the disturbance in each interval, (N, m, N)."""
    N = len(flow.new)
    return np.stack([with_residual(flow, disturbed_states(flow, row)).new for row in np.eye(N)], -1)


def memory(flow, lasting):
    """Autocorrelation of a lasting disturbance, (N, N); 0 between runs."""
    run = np.concatenate([[0], np.cumsum(flow.step <= 0)])
    time = np.concatenate([[0.0], np.cumsum(flow.step)])
    return np.exp(-np.abs(time[:, None] - time) / lasting) * (run[:, None] == run)


def dense_covariance(flow, models):
    """Covariance of all residuals, (N·m, N·m), and of each lasting disturbance with them, (D, N, N·m)."""
    N, m = flow.new.shape
    G = responses_to_disturbances(flow).reshape(N * m, N)
    covariance = np.diag(np.tile(models.sensor[0] ** 2, N)) + models.white[0, 0] ** 2 * G @ G.T
    cross = []
    for place, size, lasting in zip(models.place[0], models.size[0], models.lasting[0], strict=True):
        by = G
        if place > 0:
            by = np.zeros((N, m, N))
            by[:, place - 1] = np.eye(N)
            by = by.reshape(N * m, N)
        K = size**2 * memory(flow, lasting)
        covariance = covariance + by @ K @ by.T
        cross.append(K @ by.T)
    return covariance, np.array(cross).reshape(-1, N, N * m)


def recording(flow, models, seed=0):
    """Return the flow with a residual drawn from the model, times ``TINY``, and with masked samples."""
    random = np.random.default_rng(seed)
    covariance, _ = dense_covariance(flow, models)
    new = TINY * (np.linalg.cholesky(covariance) @ random.standard_normal(len(covariance))).reshape(flow.new.shape)
    return replace(flow, new=new, counts=(random.random(new.shape) > 0.1).astype(float))


def log_likelihood(flow, models):
    """Determinant term of the unmasked samples' log-likelihood, and its exponent divided by ``TINY**2``."""
    covariance, _ = dense_covariance(flow, models)
    used = flow.counts.ravel() > 0
    covariance, new = covariance[np.ix_(used, used)], flow.new.ravel()[used]
    return -0.5 * np.linalg.slogdet(covariance)[1], new @ np.linalg.solve(covariance, new) / TINY**2


@pytest.mark.parametrize("runs", [1, 3])
@pytest.mark.parametrize("seen", [((1.0, 0.0),), TWO_OUTPUTS], ids=["one output", "two outputs"])
@pytest.mark.parametrize("kind", MODELS)
def test_innovations_have_the_likelihood_of_the_joint_distribution(kind, seen, runs):
    models = replace(MODELS[kind], sensor=np.array([[0.1, 0.2][: len(seen)]]))
    along = recording(flow(12, seen, runs), models)
    found, counts = filtered(along.whole, models), along.whole.mine
    spread, exponent = log_likelihood(along, models)
    used = counts[:, :, None] > 0
    assert (found.standard[used] ** 2).sum() / TINY**2 == pytest.approx(exponent, rel=1e-6)
    assert -found.log_spread[used].sum() == pytest.approx(spread, rel=1e-9)
    value, scale = robust_likelihood(found, counts, np.full(len(seen), np.inf), free=False)
    assert value[0] == pytest.approx(spread - 0.5 * TINY**2 * exponent, rel=1e-9)
    assert scale[0] == 1.0


def test_models_in_a_batch_are_independent():
    first, second = MODELS["slow process"], model(white=1.0, place=(1,), size=(0.2,), lasting=(3.0,))
    along = recording(flow(20), first)
    found = filtered(along.whole, batch(first, second))
    for number, alone in enumerate((first, second)):
        expected = filtered(along.whole, alone)
        np.testing.assert_allclose(found.standard[:, :, number], expected.standard[:, :, 0], rtol=1e-12)
        np.testing.assert_allclose(found.log_spread[:, :, number], expected.log_spread[:, :, 0], rtol=1e-12)


def test_runs_are_independent():
    models = MODELS["all of them"]
    along = recording(flow(12, runs=3), models)
    whole = filtered(along.whole, models).standard
    for run in range(3):
        own = slice(12 * run, 12 * run + 12)
        alone = replace(flow(12), new=along.new[own], counts=along.counts[own])
        np.testing.assert_allclose(whole[own], filtered(alone.whole, models).standard, rtol=1e-10)


def test_innovations_without_process_noise_are_open_loop_residuals():
    along = recording(flow(30), MODELS["white process"])
    found = filtered(along.whole, model(white=1e-9, place=(0,), size=(1e-9,), lasting=(0.5,)), keep=True)
    np.testing.assert_allclose(found.standard[:, 0, 0], along.new / 0.1, rtol=1e-9)
    assert abs(found.state).max() < 1e-12


def test_shifts_of_the_trajectory_are_compensated():
    """A linear system's innovations do not depend on the linearised trajectory."""
    models = MODELS["all of them"]
    free = recording(flow(25), models)
    random = np.random.default_rng(3)
    moved = TINY * random.standard_normal(free.shift.shape)
    states = np.zeros((25, 2))
    for row in range(24):
        states[row + 1] = free.transition[row] @ states[row] + moved[row]
    other = replace(with_residual(free, -states, free.new), shift=moved)
    np.testing.assert_allclose(
        filtered(other.whole, models).standard, filtered(free.whole, models).standard, rtol=1e-5, atol=1e-12
    )


def test_innovations_are_clipped():
    models = MODELS["white process"]
    after = []
    for size in (1.0, 10.0, 1e6):
        along = flow(8)
        along.new[3] = size
        after.append(filtered(along.whole, models, keep=True).after[3, 0, 0])
    assert abs(after[2]).max() > 0.01
    np.testing.assert_allclose(after[2], after[1], rtol=1e-3)
    assert abs(after[0][0]) < abs(after[1][0])


@pytest.mark.parametrize("runs", [1, 2])
@pytest.mark.parametrize("kind", ["slow process", "slow sensor", "all of them"])
def test_smoothed_disturbances_are_conditional_means_and_covariances(kind, runs):
    models = MODELS[kind]
    along = recording(flow(15, runs=runs), models)
    covariance, cross = dense_covariance(along, models)
    used = along.counts.ravel() > 0
    covariance, new = covariance[np.ix_(used, used)], along.new.ravel()[used]
    state, spread = smoothed(along, models, filtered(along.whole, models, keep=True))
    for number, (size, row) in enumerate(zip(models.size[0], cross[..., used], strict=True)):
        mean = row @ np.linalg.solve(covariance, new)
        variance = size**2 - np.einsum("ij,ji->i", row, np.linalg.solve(covariance, row.T))
        np.testing.assert_allclose(state[:, 2 + number], mean, rtol=1e-4, atol=1e-5 * abs(mean).max())
        np.testing.assert_allclose(spread[:, 2 + number, 2 + number], variance, rtol=1e-6)


def test_smoothed_states_are_conditional_means_and_covariances():
    """With white process noise only, by the states' covariance with all residuals."""
    models = MODELS["white process"]
    along = recording(flow(15), models)
    covariance, _ = dense_covariance(along, models)
    N, used = len(along.new), along.counts.ravel() > 0
    by = np.stack([disturbed_states(along, row) for row in np.eye(N)], -1)  # (N, n, N)
    cross = 4.0 * np.einsum("inp,jp->inj", by, responses_to_disturbances(along)[:, 0])[..., used]
    covariance, new = covariance[np.ix_(used, used)], along.new.ravel()[used]
    mean = cross @ np.linalg.solve(covariance, new)
    prior = 4.0 * np.einsum("inp,imp->inm", by, by)
    expected = prior - np.einsum("inj,jk,imk->inm", cross, np.linalg.inv(covariance), cross)
    state, spread = smoothed(along, models, filtered(along.whole, models, keep=True))
    np.testing.assert_allclose(state, mean, atol=1e-5 * abs(mean).max())
    np.testing.assert_allclose(spread, expected, atol=1e-8)


class TestParts:
    """Flows split into stretches."""

    @given(count=st.integers(4, 60), runs=st.integers(1, 3), length=st.integers(1, 80), before=st.integers(0, 20))
    @settings(max_examples=40, deadline=None, derandomize=True)
    def test_each_sample_belongs_to_exactly_one_stretch(self, count, runs, length, before):
        along = flow(count, TWO_OUTPUTS, runs)
        along.counts[::3, 1] = 0.0
        along.new[:] = np.arange(along.new.size).reshape(along.new.shape) + 1.0
        parts = along.in_parts(length, before)
        mine = parts.mine > 0
        assert sorted(parts.new[mine]) == sorted(along.new[along.counts > 0])
        assert bool((parts.counts >= parts.mine).all())

    def test_a_limited_number_of_stretches_is_an_even_subset(self):
        along = flow(1000, TWO_OUTPUTS)
        along.new[:] = np.arange(along.new.size).reshape(along.new.shape) + 1.0
        every, some = along.in_parts(100, 20), along.in_parts(100, 20, 4)
        for name in ("transition", "seen", "new", "shift", "step", "counts", "mine"):
            np.testing.assert_array_equal(getattr(some, name), getattr(every, name)[:, [0, 3, 6, 9]])
        np.testing.assert_array_equal(some.inside, every.inside[[0, 3, 6, 9]])
        np.testing.assert_array_equal(along.in_parts(100, 20, 10).new, every.new)

    def test_a_single_stretch_is_the_flow(self):
        along = recording(flow(20, runs=2), MODELS["slow process"])
        for name in ("transition", "noise_input", "seen", "new", "shift", "step", "counts"):
            np.testing.assert_array_equal(getattr(along.whole, name)[:, 0], getattr(along, name))
        np.testing.assert_array_equal(along.whole.mine, along.whole.counts)
        assert not along.whole.inside.any()

    def test_stretches_have_nearly_the_likelihood_of_the_whole_flow(self):
        models = batch(MODELS["white process"], model(white=4.0), model(white=2.0, sensor=(0.15,)))
        along, random = flow(600), np.random.default_rng(2)
        along = with_residual(
            along, disturbed_states(along, course(random, along, 0.0, 2.0)), 0.1 * random.standard_normal((600, 1))
        )
        along = replace(along, spread=disturbed_states(along, course(random, along, 0.0, 2.0)).std(0))
        parts = along.in_parts(150, 100)
        assert parts.inside.tolist() == [False, True, True, True]
        values, _ = robust_likelihood(filtered(parts, models), parts.mine, along.reach)
        expected, _ = robust_likelihood(filtered(along.whole, models), along.whole.mine, along.reach)
        np.testing.assert_allclose(values, expected, atol=0.01)
        assert np.ptp(expected) > 10.0


class TestRobustLikelihood:
    """The likelihood of innovations with outliers."""

    REACH = 40.0

    @classmethod
    def of(cls, standard, log_spread=0.0):
        z = np.asarray(standard)[:, None, None, None]
        matrix, vector = np.zeros((0, 1, 1, 1, 1)), np.zeros((0, 1, 1, 1))
        found = Filtered(z, np.full(z.shape, log_spread), matrix, vector, vector, matrix)
        return robust_likelihood(found, np.ones((*z.shape[:2], 1)), np.array([cls.REACH]))

    def test_the_scale_converges_in_six_steps(self, monkeypatch):
        random = np.random.default_rng(0)
        z = random.standard_normal(400) * np.where(random.random(400) < 0.2, 8.0, 2.0)
        _, expected = self.of(z)
        monkeypatch.setattr(kalman, "_SCALINGS", 6)
        np.testing.assert_allclose(self.of(z)[1], expected, rtol=1e-8)

    def test_the_scale_maximises_the_likelihood(self):
        z = np.random.default_rng(0).standard_t(3, 400)
        (value,), (scale,) = self.of(z)

        def at(scale):
            normal = np.exp(-0.5 * (z / scale) ** 2) / (np.sqrt(2.0 * np.pi) * scale)
            density = 0.95 * normal + 0.05 / (2.0 * self.REACH)
            return np.log(density * np.sqrt(2.0 * np.pi) / 0.95).sum()

        assert value == pytest.approx(at(scale), rel=1e-12)
        assert at(scale) >= max(at(scale * factor) for factor in (0.9, 0.99, 0.999, 1.001, 1.01, 1.1))

    @pytest.mark.parametrize("zeros", [0.4, 0.6, 1.0])
    def test_innovations_of_zero_have_a_finite_likelihood(self, zeros):
        z = np.random.default_rng(3).standard_normal(200)
        z[: int(200 * zeros)] = 0.0
        value, scale = self.of(z)
        assert np.isfinite(value).all()
        assert (scale > 0.0).all()

    def test_the_scale_of_normal_innovations_is_1_and_robust_to_outliers(self):
        z = np.random.default_rng(1).standard_normal(4000)
        assert self.of(z)[1][0] == pytest.approx(1.0, abs=0.04)
        z[::20] = 30.0
        assert self.of(z)[1][0] == pytest.approx(1.0, abs=0.05)

    def test_an_outlier_favours_no_model(self):
        """An outlier at 10 standard deviations and the same at 40 give the same likelihood."""
        z = np.random.default_rng(1).standard_normal(400)
        near, far = np.append(z, 10.0), np.append(z, 40.0)
        assert self.of(near)[0] == pytest.approx(self.of(far)[0], abs=1e-6)

    @given(factor=st.floats(1e-3, 1e3))
    @settings(max_examples=20, deadline=None, derandomize=True)
    def test_a_model_and_its_multiple_are_equally_likely(self, factor):
        """Smaller innovations with a larger spread: the scale is profiled."""
        z = np.random.default_rng(2).standard_t(4, 200)
        (value,), (scale,) = self.of(z)
        (other,), (larger,) = self.of(z / factor, np.log(factor))
        assert other == pytest.approx(value, rel=1e-9)
        assert larger * factor == pytest.approx(scale, rel=1e-6)
