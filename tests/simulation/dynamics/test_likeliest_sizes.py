"""Sizes at the peak of the likelihood: what is fitted, what is held, and where they stay as they were."""

import numpy as np
import pytest

from mkc_torch.simulation.dynamics.most_likely_sizes import most_likely_sizes
from mkc_torch.simulation.dynamics.noise_model import NoiseModel
from mkc_torch.simulation.dynamics.peak import peak
from tests.simulation.dynamics.test_disturbances import LASTING, NOISE, PUSH, SLOW, WHITE, world


def test_a_narrow_ridge_that_bends_is_followed_to_its_end():
    def ridge(x):
        return -5e2 * (x[:, 1] - x[:, 0] ** 2 - 0.2 * x[:, 0]) ** 2 - 40.0 * (x[:, 0] - 0.4) ** 2

    at, curvature = peak(ridge, np.zeros(2))
    assert at == pytest.approx([0.4, 0.24], abs=0.012)  # a tenth of a standard error
    assert np.sqrt(np.diagonal(np.linalg.inv(curvature)))[0] == pytest.approx(1.0 / np.sqrt(80.0), rel=0.2)


@pytest.mark.parametrize(("truth", "time"), [(WHITE, 0.0), (SLOW, LASTING)], ids=["white", "slow"])
def test_a_start_that_is_off_ends_where_a_true_one_does(truth, time):
    along = world(truth, count=2000)
    ends = [
        most_likely_sizes(along, NoiseModel((by * NOISE,), ((0, 1.4 * by * PUSH, time),), (False,)), None)
        for by in (1.0, 0.8)
    ]
    sizes = [(noise.pushes[0][1], noise.sensor[0], *error) for noise, error in ends]
    assert sizes[0] == pytest.approx(sizes[1], rel=0.1)
    assert abs(np.log(sizes[0][0] / sizes[1][0])) < 0.1 * sizes[0][2]
    assert abs(np.log(sizes[0][0] / PUSH)) < 3.0 * sizes[0][2]


def test_declared_noise_is_held_and_nothing_is_fitted_without_a_push():
    along = world(WHITE, count=2000)
    noise, (error,) = most_likely_sizes(along, NoiseModel((1.3 * NOISE,), ((0, PUSH, 0.0),), (True,)), None)
    assert noise.sensor == (1.3 * NOISE,)
    assert error < 0.1
    alone = NoiseModel((NOISE,))
    assert most_likely_sizes(along, alone, None) == (alone, ())


def test_an_implausible_size_stays_as_it_was_and_has_an_error():
    along = world(WHITE, count=2000)
    before = NoiseModel((NOISE,), ((0, 0.8 * PUSH, 0.0),), (False,))
    noise, (error,) = most_likely_sizes(along, before, np.array([0.9 * PUSH, 1.0]))
    assert noise == before
    assert 0.0 < error < 0.1
