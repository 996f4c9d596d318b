"""Filters and smoothers, against the joint normal distribution of all samples, its covariance written out."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mkc_torch.simulation.dynamics.kalman import Filtered, Models, filtered, robust_likelihood, smoothed
from tests.simulation.dynamics.oscillating import answering, course, flow, pushed

TINY = 1e-3
"""Residuals over what a model expects, so small that none of them is held for an outlier by the least."""

BOTH = ((1.0, 0.0), (0.3, 1.0))


def model(white=0.0, place=(), size=(), lasting=(), sensor=(0.1,)):
    """One model of the noise, of an oscillator whose speed is pushed."""
    return Models(
        np.array([[white]]), np.array([place], dtype=int), np.array([size]), np.array([lasting]), np.array([sensor])
    )


def together(*models):
    """Several models of one shape."""
    parts = ((getattr(one, name) for one in models) for name in ("white", "place", "size", "lasting", "sensor"))
    return Models(*(np.concatenate(list(part)) for part in parts))


MODELS = {
    "sensor alone": model(),
    "white push": model(white=2.0),
    "slow push": model(place=(0,), size=(1.5,), lasting=(0.4,)),
    "slow sensor": model(place=(1,), size=(0.3,), lasting=(0.4,)),
    "all of them": model(white=2.0, place=(1, 0), size=(0.3, 1.5), lasting=(0.4, 1.0)),
}


def from_pushes(flow):
    """Residuals by the pushes from each sample to the next, (N, m, N)."""
    N = len(flow.new)
    return np.stack([answering(flow, pushed(flow, row)).new for row in np.eye(N)], -1)


def memory(flow, lasting):
    """Correlation of a push that forgets itself in a time, (N, N): none between runs."""
    run = np.concatenate([[0], np.cumsum(flow.step <= 0)])
    time = np.concatenate([[0.0], np.cumsum(flow.step)])
    return np.exp(-np.abs(time[:, None] - time) / lasting) * (run[:, None] == run)


def dense(flow, models):
    """Covariance of all residuals, and with each lasting disturbance: (N·m, N·m) and (D, N, N·m)."""
    N, m = flow.new.shape
    G = from_pushes(flow).reshape(N * m, N)
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
    """The flow with a residual that the model would leave, a thousandth of it, and samples that do not count."""
    random = np.random.default_rng(seed)
    covariance, _ = dense(flow, models)
    new = TINY * (np.linalg.cholesky(covariance) @ random.standard_normal(len(covariance))).reshape(flow.new.shape)
    return replace(flow, new=new, counts=(random.random(new.shape) > 0.1).astype(float))


def log_likelihood(flow, models):
    """Of the samples that count, without what is the same for all models; and the exponent, over that of the model."""
    covariance, _ = dense(flow, models)
    used = flow.counts.ravel() > 0
    covariance, new = covariance[np.ix_(used, used)], flow.new.ravel()[used]
    return -0.5 * np.linalg.slogdet(covariance)[1], new @ np.linalg.solve(covariance, new) / TINY**2


@pytest.mark.parametrize("runs", [1, 3])
@pytest.mark.parametrize("seen", [((1.0, 0.0),), BOTH], ids=["one output", "two outputs"])
@pytest.mark.parametrize("kind", MODELS)
def test_innovations_have_the_likelihood_of_all_samples_together(kind, seen, runs):
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


def test_models_beside_one_another_are_each_as_by_itself():
    one, other = MODELS["slow push"], model(white=1.0, place=(1,), size=(0.2,), lasting=(3.0,))
    along = recording(flow(20), one)
    found = filtered(along.whole, together(one, other))
    for number, alone in enumerate((one, other)):
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


def test_without_pushes_what_is_new_is_the_free_run_s_residual():
    along = recording(flow(30), MODELS["white push"])
    found = filtered(along.whole, model(white=1e-9, place=(0,), size=(1e-9,), lasting=(0.5,)), keep=True)
    np.testing.assert_allclose(found.standard[:, 0, 0], along.new / 0.1, rtol=1e-9)
    assert abs(found.state).max() < 1e-12


def test_a_trajectory_that_moved_by_itself_is_taken_back():
    """Whichever trajectory is linearised, a linear system's innovations are the same."""
    models = MODELS["all of them"]
    free = recording(flow(25), models)
    random = np.random.default_rng(3)
    moved = TINY * random.standard_normal(free.shift.shape)
    states = np.zeros((25, 2))
    for row in range(24):
        states[row + 1] = free.carried[row] @ states[row] + moved[row]
    other = replace(answering(free, -states, free.new), shift=moved)
    np.testing.assert_allclose(
        filtered(other.whole, models).standard, filtered(free.whole, models).standard, rtol=1e-5, atol=1e-12
    )


def test_an_innovation_far_out_moves_the_states_no_further_than_one_at_the_edge():
    models = MODELS["white push"]
    after = []
    for size in (0.03, 10.0, 1e6):
        along = flow(8)
        along.new[3] = size
        after.append(filtered(along.whole, models, keep=True).after[3, 0, 0])
    assert abs(after[2]).max() > 0.01
    np.testing.assert_allclose(after[2], after[1], rtol=1e-3)
    assert abs(after[0][0]) < abs(after[1][0])


@pytest.mark.parametrize("runs", [1, 2])
@pytest.mark.parametrize("kind", ["slow push", "slow sensor", "all of them"])
def test_what_is_smoothed_is_the_mean_and_the_covariance_given_all_samples(kind, runs):
    models = MODELS[kind]
    along = recording(flow(15, runs=runs), models)
    covariance, cross = dense(along, models)
    used = along.counts.ravel() > 0
    covariance, new = covariance[np.ix_(used, used)], along.new.ravel()[used]
    state, spread = smoothed(along, models, filtered(along.whole, models, keep=True))
    for number, (size, one) in enumerate(zip(models.size[0], cross[..., used], strict=True)):
        mean = one @ np.linalg.solve(covariance, new)
        variance = size**2 - np.einsum("ij,ji->i", one, np.linalg.solve(covariance, one.T))
        np.testing.assert_allclose(state[:, 2 + number], mean, rtol=1e-4, atol=1e-5 * abs(mean).max())
        np.testing.assert_allclose(spread[:, 2 + number, 2 + number], variance, rtol=1e-6)


def test_states_are_smoothed_too():
    """With white pushes alone: their covariance with all residuals, by the same sums."""
    models = MODELS["white push"]
    along = recording(flow(15), models)
    covariance, _ = dense(along, models)
    N, used = len(along.new), along.counts.ravel() > 0
    by = np.stack([pushed(along, row) for row in np.eye(N)], -1)  # (N, n, N)
    cross = 4.0 * np.einsum("inp,jp->inj", by, from_pushes(along)[:, 0])[..., used]
    covariance, new = covariance[np.ix_(used, used)], along.new.ravel()[used]
    mean = cross @ np.linalg.solve(covariance, new)
    prior = 4.0 * np.einsum("inp,imp->inm", by, by)
    expected = prior - np.einsum("inj,jk,imk->inm", cross, np.linalg.inv(covariance), cross)
    state, spread = smoothed(along, models, filtered(along.whole, models, keep=True))
    np.testing.assert_allclose(state, mean, atol=1e-5 * abs(mean).max())
    np.testing.assert_allclose(spread, expected, atol=1e-8)


class TestParts:
    """A flow in stretches."""

    @given(count=st.integers(4, 60), runs=st.integers(1, 3), length=st.integers(1, 80), before=st.integers(0, 20))
    @settings(max_examples=40, deadline=None, derandomize=True)
    def test_each_sample_is_of_one_stretch(self, count, runs, length, before):
        along = flow(count, BOTH, runs)
        along.counts[::3, 1] = 0.0
        along.new[:] = np.arange(along.new.size).reshape(along.new.shape) + 1.0
        parts = along.in_parts(length, before)
        mine = parts.mine > 0
        assert sorted(parts.new[mine]) == sorted(along.new[along.counts > 0])
        assert bool((parts.counts >= parts.mine).all())

    def test_some_stretches_are_those_of_all_spread_over_them(self):
        along = flow(1000, BOTH)
        along.new[:] = np.arange(along.new.size).reshape(along.new.shape) + 1.0
        every, some = along.in_parts(100, 20), along.in_parts(100, 20, 4)
        for name in ("carried", "seen", "new", "shift", "step", "counts", "mine"):
            np.testing.assert_array_equal(getattr(some, name), getattr(every, name)[:, [0, 3, 6, 9]])
        np.testing.assert_array_equal(some.inside, every.inside[[0, 3, 6, 9]])
        np.testing.assert_array_equal(along.in_parts(100, 20, 10).new, every.new)

    def test_one_stretch_is_the_flow(self):
        along = recording(flow(20, runs=2), MODELS["slow push"])
        for name in ("carried", "pushed", "seen", "new", "shift", "step", "counts"):
            np.testing.assert_array_equal(getattr(along.whole, name)[:, 0], getattr(along, name))
        np.testing.assert_array_equal(along.whole.mine, along.whole.counts)
        assert not along.whole.inside.any()

    def test_stretches_that_begin_within_have_all_but_the_likelihood_of_the_whole(self):
        models = together(MODELS["white push"], model(white=4.0), model(white=2.0, sensor=(0.15,)))
        along, random = flow(600), np.random.default_rng(2)
        along = answering(along, pushed(along, course(random, along, 0.0, 2.0)), 0.1 * random.standard_normal((600, 1)))
        along = replace(along, spread=pushed(along, course(random, along, 0.0, 2.0)).std(0))
        parts = along.in_parts(150, 100)
        assert parts.inside.tolist() == [False, True, True, True]
        values, _ = robust_likelihood(filtered(parts, models), parts.mine, along.reach)
        expected, _ = robust_likelihood(filtered(along.whole, models), along.whole.mine, along.reach)
        np.testing.assert_allclose(values, expected, atol=0.01)
        assert np.ptp(expected) > 10.0


class TestRobust:
    """The likelihood of innovations a few of which may be anywhere."""

    REACH = 40.0

    @classmethod
    def of(cls, standard, log_spread=0.0):
        z = np.asarray(standard)[:, None, None, None]
        matrix, vector = np.zeros((0, 1, 1, 1, 1)), np.zeros((0, 1, 1, 1))
        found = Filtered(z, np.full(z.shape, log_spread), matrix, vector, vector, matrix)
        return robust_likelihood(found, np.ones((*z.shape[:2], 1)), np.array([cls.REACH]))

    def test_the_scale_is_the_likeliest(self):
        z = np.random.default_rng(0).standard_t(3, 400)
        (value,), (scale,) = self.of(z)

        def at(one):
            normal = np.exp(-0.5 * (z / one) ** 2) / (np.sqrt(2.0 * np.pi) * one)
            density = 0.95 * normal + 0.05 / (2.0 * self.REACH)
            return np.log(density * np.sqrt(2.0 * np.pi) / 0.95).sum()

        assert value == pytest.approx(at(scale), rel=1e-12)
        assert at(scale) >= max(at(scale * factor) for factor in (0.9, 0.99, 0.999, 1.001, 1.01, 1.1))

    def test_the_scale_is_one_for_normal_innovations_and_outliers_change_it_by_little(self):
        z = np.random.default_rng(1).standard_normal(4000)
        assert self.of(z)[1][0] == pytest.approx(1.0, abs=0.04)
        z[::20] = 30.0
        assert self.of(z)[1][0] == pytest.approx(1.0, abs=0.05)

    def test_an_outlier_speaks_for_no_model(self):
        """Of two that have it at 10 and at 40 standard deviations neither is likelier for it."""
        z = np.random.default_rng(1).standard_normal(400)
        near, far = np.append(z, 10.0), np.append(z, 40.0)
        assert self.of(near)[0] == pytest.approx(self.of(far)[0], abs=1e-6)

    @given(factor=st.floats(1e-3, 1e3))
    @settings(max_examples=20, deadline=None, derandomize=True)
    def test_a_model_and_its_multiple_are_equally_likely(self, factor):
        """Smaller innovations of a larger spread: the size is profiled out."""
        z = np.random.default_rng(2).standard_t(4, 200)
        (value,), (scale,) = self.of(z)
        (other,), (larger,) = self.of(z / factor, np.log(factor))
        assert other == pytest.approx(value, rel=1e-9)
        assert larger * factor == pytest.approx(scale, rel=1e-6)
