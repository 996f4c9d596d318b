"""Maximum-likelihood sizes: fitted numbers, fixed numbers, and rejected maxima."""

import numpy as np
import pytest

from mkc_torch.simulation.dynamics.most_likely_sizes import most_likely_sizes
from mkc_torch.simulation.dynamics.noise_model import NoiseModel
from mkc_torch.simulation.dynamics.peak import peak
from tests.simulation.dynamics.test_noise_selection import LASTING, NOISE, PROCESS, SLOW, WHITE, noisy_flow


def test_a_narrow_curved_ridge_is_followed_to_its_maximum():
    def ridge(x):
        return -5e2 * (x[:, 1] - x[:, 0] ** 2 - 0.2 * x[:, 0]) ** 2 - 40.0 * (x[:, 0] - 0.4) ** 2

    at, curvature = peak(ridge, np.zeros(2))
    assert at == pytest.approx([0.4, 0.24], abs=0.012)  # a tenth of a standard error
    assert np.sqrt(np.diagonal(np.linalg.inv(curvature)))[0] == pytest.approx(1.0 / np.sqrt(80.0), rel=0.2)


@pytest.mark.parametrize(("truth", "time"), [(WHITE, 0.0), (SLOW, LASTING)], ids=["white", "slow"])
def test_the_result_does_not_depend_on_the_start(truth, time):
    along = noisy_flow(truth, count=2000)
    ends = [
        most_likely_sizes(along, NoiseModel((by * NOISE,), ((0, 1.4 * by * PROCESS, time),), (False,)), None)
        for by in (1.0, 0.8)
    ]
    sizes = [(noise.components[0][1], noise.sensor[0], *error) for noise, error in ends]
    assert sizes[0] == pytest.approx(sizes[1], rel=0.1)
    assert abs(np.log(sizes[0][0] / sizes[1][0])) < 0.1 * sizes[0][2]
    assert abs(np.log(sizes[0][0] / PROCESS)) < 3.0 * sizes[0][2]


def test_declared_noise_is_fixed_and_models_without_disturbances_are_unchanged():
    along = noisy_flow(WHITE, count=2000)
    noise, (error,) = most_likely_sizes(along, NoiseModel((1.3 * NOISE,), ((0, PROCESS, 0.0),), (True,)), None)
    assert noise.sensor == (1.3 * NOISE,)
    assert error < 0.1
    alone = NoiseModel((NOISE,))
    assert most_likely_sizes(along, alone, None) == (alone, ())


def test_an_implausible_maximum_keeps_the_size_and_returns_its_error():
    along = noisy_flow(WHITE, count=2000)
    before = NoiseModel((NOISE,), ((0, 0.8 * PROCESS, 0.0),), (False,))
    noise, (error,) = most_likely_sizes(along, before, np.array([0.9 * PROCESS, 1.0]))
    assert noise == before
    assert 0.0 < error < 0.1
