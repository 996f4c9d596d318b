"""The most likely noise of a prepared simulation, and its disturbances over time."""

import numpy as np
import pytest
import torch

from mkc_torch.simulation.dynamics.noise import disturbance_paths, most_likely_noise, sized_noise
from mkc_torch.simulation.dynamics.noise_selection import SelectedNoise
from mkc_torch.simulation.dynamics.observer import Disturbance
from tests.simulation.dynamics.oscillating import course, disturbed_states, flow, oscillator, recorded, theta_of

NOISE = 0.01
WHITE, SLOW = Disturbance("speed", True, 0.0, 1.0), Disturbance("speed", True, 1.0, 1.0)
DRIFT = Disturbance("position", False, 1.0, 0.1)


def disturbed_oscillator(*disturbances, count=300, runs=1, seed=0):
    """Return a prepared oscillator under these disturbances, its parameters, and the disturbances over time."""
    along, random = flow(count, runs=runs), np.random.default_rng(seed)
    courses = [course(random, along, disturbance.lasting, disturbance.size) for disturbance in disturbances]
    process_noise = sum(
        (c for c, disturbance in zip(courses, disturbances, strict=True) if disturbance.at_rate),
        np.zeros(len(along.new)),
    )
    position = disturbed_states(along, process_noise)[:, 0] + NOISE * random.standard_normal(len(process_noise))
    position += sum(c for c, disturbance in zip(courses, disturbances, strict=True) if not disturbance.at_rate)
    prepared = oscillator(step=0.05).prepare(recorded(along, runs, position=position))
    return prepared, theta_of(prepared), courses


def noise_model_of(theta, *disturbances):
    return SelectedNoise(disturbances, (), (), theta.new_tensor([NOISE]), 0.0, (False,))


def select_noise(prepared, theta, declared=None, **settings):
    return most_likely_noise(prepared, theta, {}, None, declared=declared or {}, least=8.0, most=2, **settings)


class TestPaths:
    """Disturbances over time, estimated from all samples."""

    @pytest.mark.parametrize("truth", [(WHITE,), (SLOW,), (DRIFT,), (SLOW, DRIFT)])
    def test_two_standard_errors_cover_the_truth_in_95_percent_of_samples(self, truth):
        prepared, theta, courses = disturbed_oscillator(*truth, count=100, runs=8)
        found = disturbance_paths(prepared, theta, {}, None, noise_model_of(theta, *truth))
        assert len(found) == len(truth)
        for path, expected, disturbance in zip(found, courses, truth, strict=True):
            away = (path.value - torch.from_numpy(expected)) / path.error
            assert 0.90 < float((away.abs() < 1.96).double().mean()) < 0.99
            assert float(away.square().mean()) == pytest.approx(1.0, abs=0.35)
            # the estimate is more precise than the prior
            assert float(path.error.median()) < 0.95 * disturbance.size

    def test_slow_process_noise_is_estimated(self):
        prepared, theta, (expected,) = disturbed_oscillator(SLOW)
        (path,) = disturbance_paths(prepared, theta, {}, None, noise_model_of(theta, SLOW))
        assert np.corrcoef(path.value.numpy(), expected)[0, 1] > 0.8

    def test_the_estimate_is_the_same_along_an_observed_run(self):
        """Its states are closer to the truth; its disturbances are the same."""
        prepared, theta, _ = disturbed_oscillator(SLOW)
        found = select_noise(prepared, theta, known=noise_model_of(theta, SLOW))
        (free,) = disturbance_paths(prepared, theta, {}, None, found.selected)
        (corrected,) = disturbance_paths(prepared.observed(found.observer), theta, {}, None, found.selected)
        assert float((free.value - corrected.value).abs().max()) < 0.25 * float(free.error.median())

    def test_no_paths_without_disturbances(self):
        prepared, theta, _ = disturbed_oscillator(count=40)
        assert disturbance_paths(prepared, theta, {}, None, noise_model_of(theta)) == ()


class TestMostLikelyNoise:
    """The most likely noise of a prepared simulation."""

    def test_process_noise_and_its_observer_are_found(self):
        prepared, theta, _ = disturbed_oscillator(WHITE)
        found = select_noise(prepared, theta)
        (disturbance,) = found.selected.disturbances
        assert (disturbance.place, disturbance.at_rate, disturbance.lasting) == ("speed", True, 0.0)
        assert abs(np.log(disturbance.size)) < 3.0 * found.selected.errors[0]
        assert found.observer.disturbances == (disturbance,)
        assert found.observer.outputs == ("position",)
        left = prepared.observed(found.observer).residual(theta, {})
        assert float(left.std()) < 0.5 * float(prepared.residual(theta, {}).std())

    @pytest.mark.parametrize("seed", range(4))
    def test_strong_process_noise_is_found_far_from_the_simulated_states(self, seed):
        prepared, theta, _ = disturbed_oscillator(Disturbance("speed", True, 0.6, 20.0), seed=seed)
        assert float(prepared.residual(theta, {}).std()) > 50.0 * NOISE
        found = sized_noise(prepared, theta, {}, None, select_noise(prepared, theta)).selected
        (disturbance,), (error,) = found.disturbances, found.errors
        assert (disturbance.place, disturbance.at_rate) == ("speed", True)
        assert 0.2 < disturbance.lasting < 1.8
        assert error < 0.2
        assert abs(np.log(disturbance.size / 20.0)) < 3.0 * error

    def test_white_noise_has_no_disturbances_and_no_observer(self):
        prepared, theta, _ = disturbed_oscillator()
        found = select_noise(prepared, theta)
        assert (found.selected.disturbances, found.observer) == ((), None)
        assert found.selected.sensor.item() == pytest.approx(NOISE, rel=0.1)

    def test_declared_noise_is_kept(self):
        prepared, theta, _ = disturbed_oscillator(WHITE)
        found = select_noise(prepared, theta, declared={"position": 0.0101})
        assert found.selected.sensor.tolist() == [0.0101]
        assert found.selected.declared == (True,)

    def test_the_selection_is_repeatable_along_the_observed_run(self):
        prepared, theta, _ = disturbed_oscillator(WHITE)
        first = select_noise(prepared, theta)
        again = select_noise(prepared.observed(first.observer), theta)
        (disturbance,), (other,) = first.selected.disturbances, again.selected.disturbances
        assert (disturbance.place, disturbance.lasting) == (other.place, other.lasting)
        assert abs(np.log(disturbance.size / other.size)) < first.selected.errors[0]

    def test_known_disturbances_are_rescaled_and_removed_without_gain(self):
        prepared, theta, _ = disturbed_oscillator(WHITE)
        found = select_noise(prepared, theta, known=noise_model_of(theta, Disturbance("speed", True, 0.0, 30.0), DRIFT))
        (disturbance,) = found.selected.disturbances
        assert (disturbance.place, disturbance.lasting) == ("speed", 0.0)
        assert abs(np.log(disturbance.size)) < 3.0 * found.selected.errors[0]
        calm, theta, _ = disturbed_oscillator()
        assert select_noise(calm, theta, known=noise_model_of(theta, WHITE)).observer is None

    def test_no_noise_without_a_trajectory(self):
        prepared, theta, _ = disturbed_oscillator(count=40)
        theta[:2] = torch.nan
        assert select_noise(prepared, theta) is None
