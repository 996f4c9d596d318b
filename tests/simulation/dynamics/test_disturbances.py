"""The likeliest noise of the world, sought in residuals whose pushes and noise are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.linalg import solve_discrete_are

from mkc_torch.simulation.dynamics.kalman import filtered, robust_likelihood
from mkc_torch.simulation.dynamics.noise_selection import (
    SelectedNoise,
    models_of,
    observer_of,
    rescale_noise_model,
    select_noise_model,
    usual_size,
)
from mkc_torch.simulation.dynamics.observer import Disturbance
from mkc_torch.simulation.dynamics.parallel_filter import filtered_whole
from tests.simulation.dynamics.oscillating import STEP, answering, course, flow, pushed

NOISE, PUSH, WANDER, LASTING = 0.01, 1.0, 0.05, 0.6
RATES, OUTPUTS = ("speed",), ("position",)
LEAST = 5.0

WHITE = Disturbance("speed", True, 0.0, PUSH)
SLOW = Disturbance("speed", True, LASTING, PUSH)
SENSOR = Disturbance("position", False, LASTING, WANDER)


def world(*disturbances, count=300, seed=0, noise=NOISE, runs=1):
    """The flow of an oscillator under these, with white noise of its sensor."""
    along, random = flow(count, runs=runs), np.random.default_rng(seed)
    error = noise * random.standard_normal(along.new.shape)
    push = np.zeros(len(along.new))
    for one in disturbances:
        values = course(random, along, one.lasting, one.size)
        if one.at_rate:
            push += values
        else:
            error[:, 0] += values
    return answering(along, pushed(along, push), error)


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def sought(along, *, floor=(NOISE,), known=(False,), least=LEAST, most=2, outputs=OUTPUTS):
    return select_noise_model(along, RATES, outputs, tensor(*floor), known, least, most)


def known(*disturbances, declared=False):
    """A noise that was found elsewhere."""
    return SelectedNoise(disturbances, (), (), tensor(NOISE), 0.0, (declared,))


def value_of(along, disturbance, sensor):
    """Log-likelihood by all samples."""
    kept = filtered_whole(along, models_of(along, (disturbance,), sensor, RATES, OUTPUTS))
    return float(robust_likelihood(kept, along.counts[:, None], along.reach, free=False)[0][0])


class TestSought:
    """What is found where nothing is known."""

    @pytest.mark.parametrize("seed", range(5))
    @pytest.mark.parametrize("truth", [WHITE, SLOW, SENSOR], ids=["white push", "slow push", "slow sensor"])
    def test_a_disturbance_is_found_where_it_is_and_of_its_size(self, truth, seed):
        found = sought(world(truth, seed=seed))
        (one,), (error,), (gain,) = found.disturbances, found.errors, found.gains
        assert (one.place, one.at_rate) == (truth.place, truth.at_rate)
        assert (one.lasting > 0.0) == (truth.lasting > 0.0)
        assert abs(np.log(one.size / truth.size)) < 3.0 * error
        assert error < 0.4
        assert gain > 50.0
        if truth.lasting:
            assert LASTING / 3.0 < one.lasting < 3.0 * LASTING

    def test_a_long_recording_tells_a_size_as_exactly_as_all_of_its_samples_do(self):
        found = sought(world(WHITE, count=6000), most=1)
        (one,), (error,), (gain,) = found.disturbances, found.errors, found.gains
        assert abs(np.log(one.size / PUSH)) < 3.0 * error < 0.1
        short = sought(world(WHITE, count=3000), most=1)
        assert error == pytest.approx(short.errors[0] / np.sqrt(2.0), rel=0.05)
        assert gain > 1.5 * short.gains[0]

    @pytest.mark.parametrize("truth", [WHITE, SLOW], ids=["white push", "slow push"])
    def test_a_size_is_where_a_dense_scan_has_the_likeliest(self, truth):
        along = world(truth, count=6000, seed=1)
        found = sought(along, most=1)
        (one,) = found.disturbances
        away = np.linspace(-0.1, 0.1, 81)
        scanned = [replace(one, size=one.size * np.exp(by)) for by in away]
        parts = [models_of(along, (other,), found.sensor, RATES, OUTPUTS) for other in scanned]
        values = [
            float(robust_likelihood(filtered_whole(along, each), along.counts[:, None], along.reach, free=False)[0][0])
            for each in parts
        ]
        assert abs(away[int(np.argmax(values))]) < 0.2 * found.errors[0]
        assert values[40] == pytest.approx(found.log_likelihood, abs=0.1)

    def test_sizes_in_the_mean_of_draws_are_the_true_ones(self):
        sizes = [sought(world(WHITE, count=3000, seed=seed), most=1) for seed in range(8)]
        away = np.mean([np.log(found.disturbances[0].size / PUSH) for found in sizes])
        assert abs(away) < 3.0 * sizes[0].errors[0] / np.sqrt(8)

    def test_the_white_noise_beside_a_push_is_that_of_the_sensor(self):
        assert sought(world(WHITE, count=500)).sensor.item() == pytest.approx(NOISE, rel=0.15)

    def test_white_noise_alone_is_nothing_else_in_most_draws(self):
        found = [sought(world(count=150, seed=seed)) for seed in range(20)]
        assert sum(one.disturbances == () for one in found) >= 17
        sizes = [one.sensor.item() for one in found]
        assert np.mean(sizes) == pytest.approx(NOISE, rel=0.05)

    def test_the_standard_error_is_that_of_repeated_draws(self):
        found = [sought(world(WHITE, count=200, seed=seed), most=1) for seed in range(12)]
        sizes = np.log([one.disturbances[0].size for one in found])
        usual = np.mean([one.errors[0] for one in found])
        assert 0.5 < sizes.std(ddof=1) / usual < 1.6

    @pytest.mark.parametrize("seed", [0, 3, 5])
    def test_what_stood_for_another_that_was_found_later_is_dropped(self, seed):
        """A white push is taken up first where a slow one is not yet tried at a time constant near its own."""
        found = sought(world(SLOW, count=100, runs=4, seed=seed))
        (one,), (error,) = found.disturbances, found.errors
        assert (one.place, one.at_rate, one.lasting > 0.0) == ("speed", True, True)
        assert abs(np.log(one.size / PUSH)) < 3.0 * error
        assert found.gains[0] > 500.0

    def test_a_flow_on_which_outliers_do_not_count(self):
        along = world(WHITE)
        along.new[::7] += 30.0
        along.counts[::7] = 0.0
        found = sought(along)
        assert abs(np.log(found.disturbances[0].size / PUSH)) < 3.0 * found.errors[0]

    def test_no_more_than_are_asked_for_and_none_that_gains_less(self):
        along = world(WHITE, SENSOR)
        assert sought(along, most=0).disturbances == ()
        assert len(sought(along, most=1).disturbances) == 1
        assert sought(along, least=1e6).disturbances == ()
        assert min(sought(along).gains) > LEAST

    def test_more_noise_that_gains_is_likelier(self):
        along = world(WHITE)
        one, none = sought(along), sought(along, most=0)
        assert one.log_likelihood - none.log_likelihood > sum(one.gains) - 1e-6

    def test_declared_noise_is_kept(self):
        for truth in ((), (WHITE,)):
            found = sought(world(*truth), floor=(1.01 * NOISE,), known=(True,))
            assert found.sensor.tolist() == [1.01 * NOISE]
            assert found.declared == (True,)
        (one,) = found.disturbances
        assert one.size == pytest.approx(PUSH, rel=0.3)

    def test_noise_beyond_what_is_declared_is_a_disturbance(self):
        assert sought(world(), known=(True,)).disturbances == ()
        assert sought(world(noise=3.0 * NOISE), known=(True,)).disturbances != ()

    def test_each_of_two_outputs_has_a_noise_of_its_own(self):
        along, random = flow(300, ((1.0, 0.0), (0.0, 1.0))), np.random.default_rng(1)
        noise = random.standard_normal(along.new.shape) * [0.01, 0.2]
        noise[:, 1] += course(random, along, LASTING, 1.0)
        along = answering(along, pushed(along, np.zeros(300)), noise)
        found = sought(
            along,
            floor=(0.03, 0.03),
            known=(False, False),
            outputs=("position", "speed"),
        )
        (one,) = found.disturbances
        # a state and an output of one name
        assert (one.place, one.at_rate) == ("speed", False)
        # by how much it changes from sample to sample is known best
        assert one.size**2 / one.lasting == pytest.approx(1.0 / LASTING, rel=0.35)
        assert found.sensor.tolist() == pytest.approx([0.01, 0.2], rel=0.35)
        # of what is returned, but for what counts as far out
        models = models_of(along, found.disturbances, found.sensor, RATES, ("position", "speed"))
        (value,), (scale,) = robust_likelihood(filtered(along.whole, models), along.whole.mine, along.reach)
        assert value == pytest.approx(found.log_likelihood, abs=0.05)
        assert scale == pytest.approx(1.0, abs=0.01)


class TestResized:
    """Known disturbances along another flow."""

    @pytest.mark.parametrize("truth", [WHITE, SLOW, SENSOR], ids=["white push", "slow push", "slow sensor"])
    def test_a_disturbance_has_its_size_there(self, truth):
        before = replace(truth, size=20.0 * truth.size)
        found = rescale_noise_model(world(truth), RATES, OUTPUTS, known(before), LEAST)
        (one,) = found.disturbances
        assert (one.place, one.at_rate) == (truth.place, truth.at_rate)
        assert abs(np.log(one.size / truth.size)) < 3.0 * found.errors[0]
        assert found.gains[0] > 50.0

    def test_what_is_needless_there_is_dropped(self):
        found = rescale_noise_model(world(WHITE), RATES, OUTPUTS, known(WHITE, SENSOR), LEAST)
        assert [(one.place, one.at_rate) for one in found.disturbances] == [("speed", True)]
        assert len(found.gains) == len(found.errors) == 1
        nothing = rescale_noise_model(world(), RATES, OUTPUTS, known(WHITE, SENSOR), LEAST)
        assert (nothing.disturbances, nothing.gains, nothing.errors) == ((), (), ())
        assert nothing.sensor.item() == pytest.approx(NOISE, rel=0.1)

    def test_declared_noise_is_kept(self):
        for truth in ((), (SLOW,)):
            found = rescale_noise_model(world(*truth), RATES, OUTPUTS, known(SLOW, declared=True), LEAST)
            assert found.sensor.tolist() == [NOISE]
            assert found.declared == (True,)
            assert len(found.disturbances) == len(truth)


class TestUsualSize:
    """Of a push that moves an output by its noise."""

    def test_of_white_pushes_by_their_sum(self):
        along = flow(900)
        answer = pushed(along, np.arange(900) == 0)[1:401, 0]
        expected = 0.02 / np.sqrt((answer**2).sum())
        assert usual_size(along, 0, 0.0, np.array([0.02])) == pytest.approx(expected, rel=1e-9)

    def test_of_a_lasting_one_by_the_most_that_it_moves(self):
        answer = pushed(flow(900), np.arange(900) * STEP <= 1.02)[:, 0].max()
        assert usual_size(flow(900), 0, 1.02, np.array([0.02])) == pytest.approx(0.02 / answer, rel=1e-9)

    def test_infinite_where_no_output_moves(self):
        assert usual_size(flow(50, ((0.0, 0.0),)), 0, 0.0, np.array([0.02])) == np.inf


class TestObserverOf:
    """The gains of a noise."""

    def test_none_for_white_noise_of_the_sensors(self):
        assert observer_of(flow(10), (), tensor(NOISE), RATES, OUTPUTS) is None

    @pytest.mark.parametrize("truth", [(WHITE,), (SLOW,), (SENSOR,), (WHITE, SENSOR)])
    def test_gains_settle_at_those_of_the_riccati_equation(self, truth):
        along = flow(2000)
        lasting = [one for one in truth if one.lasting]
        n, k = 2, 2 + len(lasting)
        A, Q, C = np.zeros((k, k)), np.zeros((k, k)), np.zeros((1, k))
        A[:n, :n], C[0, 0] = along.carried[0], 1.0
        if WHITE in truth:
            Q[:n, :n] = PUSH**2 * along.pushed[0] @ along.pushed[0].T
        for place, one in enumerate(lasting, n):
            A[place, place] = np.exp(-STEP / one.lasting)
            Q[place, place] = one.size**2 * (1.0 - A[place, place] ** 2)
            if one.at_rate:
                A[:n, place] = along.pushed[0][:, 0]
            else:
                C[0, place] = 1.0
        P = solve_discrete_are(A.T, C.T, Q, [[NOISE**2]])
        S = C @ P @ C.T + NOISE**2
        observer = observer_of(along, truth, tensor(NOISE), RATES, OUTPUTS)
        np.testing.assert_allclose(observer.gain[-1].numpy(), P @ C.T / S, rtol=1e-6, atol=1e-9)
        assert observer.spread[-1].item() == pytest.approx(np.sqrt(S.item()), rel=1e-9)
        assert observer.lasting == tuple(lasting)

    def test_what_is_whitened_is_white_and_of_one_size(self):
        along = flow(3000, ((1.0, 0.0), (0.0, 1.0)))
        random = np.random.default_rng(5)
        noise = random.standard_normal(along.new.shape) * [0.01, 0.1]
        along = answering(along, pushed(along, course(random, along, 0.0, PUSH)), noise)
        outputs = ("position", "speed")
        observer = observer_of(along, (WHITE,), tensor(0.01, 0.1), RATES, outputs)
        diagonal = observer.white.diagonal(dim1=1, dim2=2)
        torch.testing.assert_close(diagonal.log().mean(0), tensor(0.0, 0.0), rtol=0.0, atol=1e-12)
        models = models_of(along, (WHITE,), tensor(0.01, 0.1), RATES, outputs)
        state = filtered(along.whole, models, keep=True).state[:, 0, 0]
        white = observer.whitened(torch.from_numpy(along.new - np.einsum("nij,nj->ni", along.seen, state))).numpy()
        correlation = np.corrcoef(np.concatenate([white[1:], white[:-1]], 1).T)
        assert abs(correlation - np.eye(4)).max() < 4.0 / np.sqrt(3000)
        assert white[:1500].std(0) == pytest.approx(white[1500:].std(0), rel=0.1)

    def test_a_sample_that_does_not_count_moves_nothing(self):
        along = flow(20)
        along.counts[7] = 0.0
        gain = observer_of(along, (WHITE,), tensor(NOISE), RATES, OUTPUTS).gain
        assert not gain[7].any()
        assert gain[6].all()
        assert gain[8].all()


def test_a_state_and_an_output_of_one_name_are_told_apart():
    pushes = (Disturbance("speed", True, 1.0, 2.0), Disturbance("speed", False, 1.0, 3.0))
    models = models_of(flow(5), pushes, tensor(1.0, 1.0), ("speed",), ("position", "speed"))
    assert models.place.tolist() == [[0, 2]]
    assert models.size.tolist() == [[2.0, 3.0]]
