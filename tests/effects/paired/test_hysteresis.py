"""Paths of hysteresis against a fine integration."""

import math

import numpy as np
import torch

from mkc_torch.effects.paired.driver_hysteresis import dahl_path


def integrated(position, yields, steps=2000):
    """Return Dahl's state by explicit steps."""
    z, path = 0.0, [0.0]
    for travel in np.diff(position):
        for _ in range(steps):
            z += travel / steps - abs(travel) / steps * z / yields
        path.append(z)
    return np.array(path)


def test_dahl_path_equals_a_fine_integration():
    position = np.cumsum(np.random.default_rng(0).normal(0.0, 0.4, 60))
    path = dahl_path(torch.tensor(position), 0.7, torch.zeros(60, dtype=torch.long))
    np.testing.assert_allclose(path.numpy(), integrated(position, 0.7), atol=1e-3)


def test_dahl_path_starts_again_in_each_run():
    position = torch.tensor([0.0, 1.0, 2.0, 0.0, 1.0, 2.0]).double()
    path = dahl_path(position, 1.0, torch.tensor([0, 0, 0, 1, 1, 1]))
    assert torch.equal(path[:3], path[3:])
    assert float(path[2]) == 1.0 - math.exp(-2.0)
