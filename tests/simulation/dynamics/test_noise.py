"""The noise of the world around a prepared simulation, and the course of its pushes."""

import numpy as np
import pytest
import torch

from mkc_torch.simulation.dynamics.noise import likeliest_noise, noise_of, pushes_over_time
from mkc_torch.simulation.dynamics.noise_selection import SelectedNoise
from mkc_torch.simulation.dynamics.observer import Disturbance
from tests.simulation.dynamics.oscillating import course, flow, oscillator, pushed, recorded, theta_of

NOISE = 0.01
WHITE, SLOW = Disturbance("speed", True, 0.0, 1.0), Disturbance("speed", True, 1.0, 1.0)
WANDER = Disturbance("position", False, 1.0, 0.1)


def world(*disturbances, count=300, runs=1, seed=0):
    """A prepared oscillator under these, its parameters, and their courses."""
    along, random = flow(count, runs=runs), np.random.default_rng(seed)
    courses = [course(random, along, one.lasting, one.size) for one in disturbances]
    push = sum((c for c, one in zip(courses, disturbances, strict=True) if one.at_rate), np.zeros(len(along.new)))
    position = pushed(along, push)[:, 0] + NOISE * random.standard_normal(len(push))
    position += sum(c for c, one in zip(courses, disturbances, strict=True) if not one.at_rate)
    prepared = oscillator(step=0.05).prepare(recorded(along, runs, position=position))
    return prepared, theta_of(prepared), courses


def known(theta, *disturbances):
    return SelectedNoise(disturbances, (), (), theta.new_tensor([NOISE]), 0.0, (False,))


def likeliest(prepared, theta, declared=None, **settings):
    return likeliest_noise(prepared, theta, {}, None, declared=declared or {}, least=8.0, most=2, **settings)


class TestCourses:
    """Pushes over time, by all samples."""

    @pytest.mark.parametrize("truth", [(WHITE,), (SLOW,), (WANDER,), (SLOW, WANDER)])
    def test_two_standard_errors_cover_the_truth_nineteen_times_in_twenty(self, truth):
        prepared, theta, courses = world(*truth, count=100, runs=8)
        found = pushes_over_time(prepared, theta, {}, None, known(theta, *truth))
        assert len(found) == len(truth)
        for one, expected, disturbance in zip(found, courses, truth, strict=True):
            away = (one.value - torch.from_numpy(expected)) / one.error
            assert 0.90 < float((away.abs() < 1.96).double().mean()) < 0.99
            assert float(away.square().mean()) == pytest.approx(1.0, abs=0.35)
            # it says more than that there is one
            assert float(one.error.median()) < 0.95 * disturbance.size

    def test_a_slow_push_is_followed(self):
        prepared, theta, (expected,) = world(SLOW)
        (one,) = pushes_over_time(prepared, theta, {}, None, known(theta, SLOW))
        assert np.corrcoef(one.value.numpy(), expected)[0, 1] > 0.8

    def test_it_is_the_same_along_an_observed_run(self):
        """Its states are nearer to the truth; what pushes them is not."""
        prepared, theta, _ = world(SLOW)
        found = likeliest(prepared, theta, known=known(theta, SLOW))
        (free,) = pushes_over_time(prepared, theta, {}, None, found.disturbed)
        (watched,) = pushes_over_time(prepared.observed(found.observer), theta, {}, None, found.disturbed)
        assert float((free.value - watched.value).abs().max()) < 0.25 * float(free.error.median())

    def test_there_are_none_without_disturbances(self):
        prepared, theta, _ = world(count=40)
        assert pushes_over_time(prepared, theta, {}, None, known(theta)) == ()


class TestLikeliest:
    """The likeliest noise of a prepared simulation."""

    def test_a_push_and_the_observer_for_it(self):
        prepared, theta, _ = world(WHITE)
        found = likeliest(prepared, theta)
        (one,) = found.disturbed.disturbances
        assert (one.place, one.at_rate, one.lasting) == ("speed", True, 0.0)
        assert abs(np.log(one.size)) < 3.0 * found.disturbed.errors[0]
        assert found.observer.disturbances == (one,)
        assert found.observer.outputs == ("position",)
        left = prepared.observed(found.observer).residual(theta, {})
        assert float(left.std()) < 0.5 * float(prepared.residual(theta, {}).std())

    @pytest.mark.parametrize("seed", range(4))
    def test_a_push_that_takes_the_states_far_from_where_they_are_simulated(self, seed):
        prepared, theta, _ = world(Disturbance("speed", True, 0.6, 20.0), seed=seed)
        assert float(prepared.residual(theta, {}).std()) > 50.0 * NOISE
        found = likeliest(prepared, theta).disturbed
        (one,), (error,) = found.disturbances, found.errors
        assert (one.place, one.at_rate) == ("speed", True)
        assert 0.2 < one.lasting < 1.8
        assert error < 0.2
        assert abs(np.log(one.size / 20.0)) < 3.0 * error

    def test_nothing_and_no_observer_for_white_noise(self):
        prepared, theta, _ = world()
        found = likeliest(prepared, theta)
        assert (found.disturbed.disturbances, found.observer) == ((), None)
        assert found.disturbed.sensor.item() == pytest.approx(NOISE, rel=0.1)

    def test_declared_noise_is_kept(self):
        prepared, theta, _ = world(WHITE)
        found = likeliest(prepared, theta, declared={"position": 0.0101})
        assert found.disturbed.sensor.tolist() == [0.0101]
        assert found.disturbed.declared == (True,)
        again = noise_of(prepared.observed(found.observer), {"position": 0.0101})
        assert again.disturbed.declared == (True,)
        assert again.disturbed.sensor.tolist() == [0.0101]

    def test_it_is_about_the_same_along_the_observed_run(self):
        prepared, theta, _ = world(WHITE)
        first = likeliest(prepared, theta)
        again = likeliest(prepared.observed(first.observer), theta)
        (one,), (other,) = first.disturbed.disturbances, again.disturbed.disturbances
        assert (one.place, one.lasting) == (other.place, other.lasting)
        assert abs(np.log(one.size / other.size)) < first.disturbed.errors[0]

    def test_known_pushes_are_given_their_sizes_and_dropped_where_needless(self):
        prepared, theta, _ = world(WHITE)
        found = likeliest(prepared, theta, known=known(theta, Disturbance("speed", True, 0.0, 30.0), WANDER))
        (one,) = found.disturbed.disturbances
        assert (one.place, one.lasting) == ("speed", 0.0)
        assert abs(np.log(one.size)) < 3.0 * found.disturbed.errors[0]
        calm, theta, _ = world()
        assert likeliest(calm, theta, known=known(theta, WHITE)).observer is None

    def test_there_is_none_without_a_trajectory(self):
        prepared, theta, _ = world(count=40)
        theta[:2] = torch.nan
        assert likeliest(prepared, theta) is None

    def test_a_free_run_has_none(self):
        prepared, *_ = world(count=40)
        assert noise_of(prepared, {}) is None

    def test_that_of_an_observed_run_is_its_observer_s(self):
        prepared, theta, _ = world(WHITE)
        observer = likeliest(prepared, theta).observer
        found = noise_of(prepared.observed(observer), {})
        assert found.observer is observer
        assert found.disturbed.disturbances == observer.disturbances
        assert found.disturbed.declared == (False,)
