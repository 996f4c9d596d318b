"""Selection of noise models for residuals with known process noise, drift and sensor noise."""

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
    with_most_likely_sizes,
)
from mkc_torch.simulation.dynamics.observer import Disturbance
from mkc_torch.simulation.dynamics.parallel_filter import filtered_whole
from tests.simulation.dynamics.oscillating import STEP, course, disturbed_states, flow, with_residual

NOISE, PROCESS, DRIFT, LASTING = 0.01, 1.0, 0.05, 0.6
RATES, OUTPUTS = ("speed",), ("position",)
LEAST = 5.0

WHITE = Disturbance("speed", True, 0.0, PROCESS)
SLOW = Disturbance("speed", True, LASTING, PROCESS)
SENSOR = Disturbance("position", False, LASTING, DRIFT)


def noisy_flow(*disturbances, count=300, seed=0, noise=NOISE, runs=1):
    """Return the flow of an oscillator under these disturbances, with white sensor noise."""
    along, random = flow(count, runs=runs), np.random.default_rng(seed)
    error = noise * random.standard_normal(along.new.shape)
    process_noise = np.zeros(len(along.new))
    for disturbance in disturbances:
        values = course(random, along, disturbance.lasting, disturbance.size)
        if disturbance.at_rate:
            process_noise += values
        else:
            error[:, 0] += values
    return with_residual(along, disturbed_states(along, process_noise), error)


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def selected(along, *, floor=(NOISE,), known=(False,), least=LEAST, most=2, outputs=OUTPUTS):
    found = select_noise_model(along, RATES, outputs, tensor(*floor), known, least, most)
    return with_most_likely_sizes(along, RATES, outputs, found)


def known(*disturbances, declared=False):
    """Return a noise selected elsewhere."""
    return SelectedNoise(disturbances, (), (), tensor(NOISE), 0.0, (declared,))


def value_of(along, disturbance, sensor):
    """Log-likelihood of all samples."""
    kept = filtered_whole(along, models_of(along, (disturbance,), sensor, RATES, OUTPUTS))
    return float(robust_likelihood(kept, along.counts[:, None], along.reach, free=False)[0][0])


class TestSelection:
    """Selection without known disturbances."""

    @pytest.mark.parametrize("seed", range(5))
    @pytest.mark.parametrize("truth", [WHITE, SLOW, SENSOR], ids=["white process", "slow process", "slow sensor"])
    def test_place_and_size_of_a_disturbance_are_found(self, truth, seed):
        found = selected(noisy_flow(truth, seed=seed))
        (disturbance,), (error,), (gain,) = found.disturbances, found.errors, found.gains
        assert (disturbance.place, disturbance.at_rate) == (truth.place, truth.at_rate)
        assert (disturbance.lasting > 0.0) == (truth.lasting > 0.0)
        assert abs(np.log(disturbance.size / truth.size)) < 3.0 * error
        assert error < 0.4
        assert gain > 50.0
        if truth.lasting:
            assert LASTING / 3.0 < disturbance.lasting < 3.0 * LASTING

    def test_the_standard_error_of_a_size_shrinks_with_all_samples_of_a_long_recording(self):
        found = selected(noisy_flow(WHITE, count=6000), most=1)
        (disturbance,), (error,), (gain,) = found.disturbances, found.errors, found.gains
        assert abs(np.log(disturbance.size / PROCESS)) < 3.0 * error < 0.1
        short = selected(noisy_flow(WHITE, count=3000), most=1)
        assert error == pytest.approx(short.errors[0] / np.sqrt(2.0), rel=0.05)
        assert gain > 1.5 * short.gains[0]

    @pytest.mark.parametrize("truth", [WHITE, SLOW], ids=["white process", "slow process"])
    def test_a_size_is_at_the_maximum_of_a_dense_scan(self, truth):
        along = noisy_flow(truth, count=6000, seed=1)
        found = selected(along, most=1)
        (disturbance,) = found.disturbances
        away = np.linspace(-0.1, 0.1, 81)
        scanned = [replace(disturbance, size=disturbance.size * np.exp(by)) for by in away]
        parts = [replace(models_of(along, (other,), found.sensor, RATES, OUTPUTS), hard_clip=True) for other in scanned]
        values = [
            float(robust_likelihood(filtered_whole(along, each), along.counts[:, None], along.reach, free=False)[0][0])
            for each in parts
        ]
        assert abs(away[int(np.argmax(values))]) < 0.2 * found.errors[0]

    def test_sizes_are_unbiased_over_repeated_draws(self):
        sizes = [selected(noisy_flow(WHITE, count=3000, seed=seed), most=1) for seed in range(8)]
        away = np.mean([np.log(found.disturbances[0].size / PROCESS) for found in sizes])
        assert abs(away) < 3.0 * sizes[0].errors[0] / np.sqrt(8)

    def test_white_noise_under_process_noise_is_that_of_the_sensor(self):
        assert selected(noisy_flow(WHITE, count=500)).sensor.item() == pytest.approx(NOISE, rel=0.15)

    def test_white_noise_alone_selects_no_disturbance_in_most_draws(self):
        found = [selected(noisy_flow(count=150, seed=seed)) for seed in range(20)]
        assert sum(disturbance.disturbances == () for disturbance in found) >= 17
        sizes = [disturbance.sensor.item() for disturbance in found]
        assert np.mean(sizes) == pytest.approx(NOISE, rel=0.05)

    def test_the_standard_error_is_that_of_repeated_draws(self):
        found = [selected(noisy_flow(WHITE, count=200, seed=seed), most=1) for seed in range(12)]
        sizes = np.log([disturbance.disturbances[0].size for disturbance in found])
        usual = np.mean([disturbance.errors[0] for disturbance in found])
        assert 0.5 < sizes.std(ddof=1) / usual < 1.6

    @pytest.mark.parametrize("seed", [0, 3, 5])
    def test_a_disturbance_made_superfluous_by_a_later_one_is_removed(self, seed):
        """White noise is selected first, since the grid has no time constant near that of the slow disturbance."""
        found = selected(noisy_flow(SLOW, count=100, runs=4, seed=seed))
        (disturbance,), (error,) = found.disturbances, found.errors
        assert (disturbance.place, disturbance.at_rate, disturbance.lasting > 0.0) == ("speed", True, True)
        assert abs(np.log(disturbance.size / PROCESS)) < 3.0 * error
        assert found.gains[0] > 500.0

    def test_masked_outliers_do_not_change_the_size(self):
        along = noisy_flow(WHITE)
        along.new[::7] += 30.0
        along.counts[::7] = 0.0
        found = selected(along)
        assert abs(np.log(found.disturbances[0].size / PROCESS)) < 3.0 * found.errors[0]

    def test_number_and_least_gain_of_disturbances_are_respected(self):
        along = noisy_flow(WHITE, SENSOR)
        assert selected(along, most=0).disturbances == ()
        assert len(selected(along, most=1).disturbances) == 1
        assert selected(along, least=1e6).disturbances == ()
        assert min(selected(along).gains) > LEAST

    def test_the_log_likelihood_grows_by_the_gains(self):
        along = noisy_flow(WHITE)
        disturbance, none = selected(along), selected(along, most=0)
        assert disturbance.log_likelihood - none.log_likelihood > sum(disturbance.gains) - 1e-6

    def test_declared_noise_is_kept(self):
        for truth in ((), (WHITE,)):
            found = selected(noisy_flow(*truth), floor=(1.01 * NOISE,), known=(True,))
            assert found.sensor.tolist() == [1.01 * NOISE]
            assert found.declared == (True,)
        (disturbance,) = found.disturbances
        assert disturbance.size == pytest.approx(PROCESS, rel=0.3)

    def test_noise_beyond_the_declared_noise_becomes_a_disturbance(self):
        assert selected(noisy_flow(), known=(True,)).disturbances == ()
        assert selected(noisy_flow(noise=3.0 * NOISE), known=(True,)).disturbances != ()

    def test_each_of_two_outputs_has_a_noise_of_its_own(self):
        along, random = flow(300, ((1.0, 0.0), (0.0, 1.0))), np.random.default_rng(1)
        noise = random.standard_normal(along.new.shape) * [0.01, 0.2]
        noise[:, 1] += course(random, along, LASTING, 1.0)
        along = with_residual(along, disturbed_states(along, np.zeros(300)), noise)
        outputs, floor = ("position", "speed"), tensor(0.03, 0.03)
        found = select_noise_model(along, RATES, outputs, floor, (False, False), LEAST, 2)
        (disturbance,) = found.disturbances
        # a state and an output share this name
        assert (disturbance.place, disturbance.at_rate) == ("speed", False)
        # the change from sample to sample is determined best
        assert disturbance.size**2 / disturbance.lasting == pytest.approx(1.0 / LASTING, rel=0.35)
        assert found.sensor.tolist() == pytest.approx([0.01, 0.2], rel=0.35)
        # the log-likelihood of the returned model, up to the range of outliers
        models = models_of(along, found.disturbances, found.sensor, RATES, outputs)
        (value,), (scale,) = robust_likelihood(filtered(along.whole, models), along.whole.mine, along.reach)
        assert value == pytest.approx(found.log_likelihood, abs=0.05)
        assert scale == pytest.approx(1.0, abs=0.01)


class TestRescaling:
    """Known disturbances rescaled along another flow."""

    @pytest.mark.parametrize("truth", [WHITE, SLOW, SENSOR], ids=["white process", "slow process", "slow sensor"])
    def test_the_size_of_a_known_disturbance_is_refitted(self, truth):
        before = replace(truth, size=20.0 * truth.size)
        found = rescale_noise_model(noisy_flow(truth), RATES, OUTPUTS, known(before), LEAST)
        (disturbance,) = found.disturbances
        assert (disturbance.place, disturbance.at_rate) == (truth.place, truth.at_rate)
        assert abs(np.log(disturbance.size / truth.size)) < 3.0 * found.errors[0]
        assert found.gains[0] > 50.0

    def test_disturbances_without_gain_are_removed(self):
        found = rescale_noise_model(noisy_flow(WHITE), RATES, OUTPUTS, known(WHITE, SENSOR), LEAST)
        assert [(disturbance.place, disturbance.at_rate) for disturbance in found.disturbances] == [("speed", True)]
        assert len(found.gains) == len(found.errors) == 1
        nothing = rescale_noise_model(noisy_flow(), RATES, OUTPUTS, known(WHITE, SENSOR), LEAST)
        assert (nothing.disturbances, nothing.gains, nothing.errors) == ((), (), ())
        assert nothing.sensor.item() == pytest.approx(NOISE, rel=0.1)

    def test_declared_noise_is_kept(self):
        for truth in ((), (SLOW,)):
            found = rescale_noise_model(noisy_flow(*truth), RATES, OUTPUTS, known(SLOW, declared=True), LEAST)
            assert found.sensor.tolist() == [NOISE]
            assert found.declared == (True,)
            assert len(found.disturbances) == len(truth)


class TestUsualSize:
    """The size at which a disturbance moves an output by its noise."""

    def test_white_noise_accumulates_over_the_response(self):
        along = flow(900)
        answer = disturbed_states(along, np.arange(900) == 0)[1:401, 0]
        expected = 0.02 / np.sqrt((answer**2).sum())
        assert usual_size(along, 0, 0.0, np.array([0.02])) == pytest.approx(expected, rel=1e-9)

    def test_a_lasting_disturbance_is_measured_by_its_largest_response(self):
        answer = disturbed_states(flow(900), np.arange(900) * STEP <= 1.02)[:, 0].max()
        assert usual_size(flow(900), 0, 1.02, np.array([0.02])) == pytest.approx(0.02 / answer, rel=1e-9)

    def test_the_usual_size_is_infinite_if_no_output_moves(self):
        assert usual_size(flow(50, ((0.0, 0.0),)), 0, 0.0, np.array([0.02])) == np.inf


class TestObserverOf:
    """Observers of selected noise."""

    def test_white_sensor_noise_has_no_observer(self):
        assert observer_of(flow(10), (), tensor(NOISE), RATES, OUTPUTS) is None

    @pytest.mark.parametrize("truth", [(WHITE,), (SLOW,), (SENSOR,), (WHITE, SENSOR)])
    def test_gains_converge_to_the_riccati_equation(self, truth):
        along = flow(2000)
        lasting = [disturbance for disturbance in truth if disturbance.lasting]
        n, k = 2, 2 + len(lasting)
        A, Q, C = np.zeros((k, k)), np.zeros((k, k)), np.zeros((1, k))
        A[:n, :n], C[0, 0] = along.transition[0], 1.0
        if WHITE in truth:
            Q[:n, :n] = PROCESS**2 * along.noise_input[0] @ along.noise_input[0].T
        for place, disturbance in enumerate(lasting, n):
            A[place, place] = np.exp(-STEP / disturbance.lasting)
            Q[place, place] = disturbance.size**2 * (1.0 - A[place, place] ** 2)
            if disturbance.at_rate:
                A[:n, place] = along.noise_input[0][:, 0]
            else:
                C[0, place] = 1.0
        P = solve_discrete_are(A.T, C.T, Q, [[NOISE**2]])
        S = C @ P @ C.T + NOISE**2
        observer = observer_of(along, truth, tensor(NOISE), RATES, OUTPUTS)
        np.testing.assert_allclose(observer.gain[-1].numpy(), P @ C.T / S, rtol=1e-6, atol=1e-9)
        assert observer.spread[-1].item() == pytest.approx(np.sqrt(S.item()), rel=1e-9)
        assert observer.lasting == tuple(lasting)

    def test_whitened_innovations_are_white_and_of_equal_size(self):
        along = flow(3000, ((1.0, 0.0), (0.0, 1.0)))
        random = np.random.default_rng(5)
        noise = random.standard_normal(along.new.shape) * [0.01, 0.1]
        along = with_residual(along, disturbed_states(along, course(random, along, 0.0, PROCESS)), noise)
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

    def test_an_observer_has_no_gain_at_masked_samples(self):
        along = flow(20)
        along.counts[7] = 0.0
        gain = observer_of(along, (WHITE,), tensor(NOISE), RATES, OUTPUTS).gain
        assert not gain[7].any()
        assert gain[6].all()
        assert gain[8].all()


def test_a_state_and_an_output_of_the_same_name_are_distinguished():
    disturbances = (Disturbance("speed", True, 1.0, 2.0), Disturbance("speed", False, 1.0, 3.0))
    models = models_of(flow(5), disturbances, tensor(1.0, 1.0), ("speed",), ("position", "speed"))
    assert models.place.tolist() == [[0, 2]]
    assert models.size.tolist() == [[2.0, 3.0]]
