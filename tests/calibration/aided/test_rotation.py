"""Rotations, against SciPy's."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mkc_torch.calibration.aided.rotation import from_quaternion, rotation_since

RANDOM = np.random.default_rng(0)


def test_quaternions_of_any_length_give_the_rotations_of_scipy():
    q = RANDOM.standard_normal((5, 7, 4))
    found = from_quaternion(torch.from_numpy(q))
    expected = Rotation.from_quat(q[..., [1, 2, 3, 0]].reshape(-1, 4)).as_matrix().reshape(5, 7, 3, 3)
    np.testing.assert_allclose(found, expected, atol=1e-14)


@pytest.mark.parametrize("N", [1, 2, 3, 64, 65, 500])
def test_the_prefix_product_equals_a_loop_over_rotations(N):
    time = np.cumsum(0.05 * RANDOM.random(N))
    rate = 3.0 * RANDOM.standard_normal((N, 3))
    starts = np.arange(N) // 13 * 13
    found = rotation_since(torch.from_numpy(time), torch.from_numpy(rate), torch.from_numpy(starts))
    expected = np.empty((N, 3, 3))
    for k in range(N):
        if k == starts[k]:
            turned = Rotation.identity()
        else:
            mean = 0.5 * (rate[k] + rate[k - 1])
            turned = turned * Rotation.from_rotvec(mean * (time[k] - time[k - 1]))
        expected[k] = turned.as_matrix()
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_long_products_stay_rotations():
    N = 20_000
    rate = torch.from_numpy(5.0 * RANDOM.standard_normal((N, 3)))
    first = torch.zeros(N, dtype=torch.long)
    turned = rotation_since(0.01 * torch.arange(N, dtype=torch.float64), rate, first)
    eye = torch.eye(3, dtype=torch.float64).expand(N, 3, 3)
    torch.testing.assert_close(turned @ turned.mT, eye, rtol=0.0, atol=1e-12)


def test_a_sensor_at_rest_does_not_turn():
    turned = rotation_since(torch.arange(9.0), torch.zeros(9, 3), torch.zeros(9, dtype=torch.long))
    torch.testing.assert_close(turned, torch.eye(3).expand(9, 3, 3))
