"""Paths of hysteresis against a fine integration, and the grid of periods against a periodogram by NumPy."""

import math

import numpy as np
import torch

from mkc_torch.effects import Context
from mkc_torch.effects.paired.driver_hysteresis import dahl_path
from mkc_torch.effects.paired.periodic import Periodic, frequencies


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


def test_a_sinusoid_between_two_frequencies_of_the_grid_keeps_three_quarters_of_its_power():
    r = np.random.default_rng(1)
    time = np.sort(r.uniform(0.0, 40.0, 300))
    time = time[(time < 12.0) | (time > 21.0)]  # a gap
    grid = frequencies(torch.tensor(time))
    for frequency in r.uniform(grid[0], grid[-1], 5):
        wave = np.sin(2.0 * np.pi * frequency * time + r.uniform(0.0, 6.0))
        share = []
        for tried in grid:
            phase = 2.0 * np.pi * tried * time
            columns = np.stack([np.cos(phase), np.sin(phase)], -1)
            left = wave - columns @ np.linalg.lstsq(columns, wave, rcond=None)[0]
            share.append(1.0 - left @ left / (wave @ wave))
        assert max(share) > 0.75


def test_frequencies_end_below_half_of_the_sampling_rate_and_at_a_largest_number():
    grid = frequencies(torch.arange(100).double() / 10.0)
    assert 4.9 < grid[-1] < 5.0
    assert len(frequencies(torch.arange(100_000).double())) == 1200
    assert frequencies(torch.zeros(5)) == []


def test_a_periodic_change_is_a_cosine_and_a_sine_since_the_start():
    time = torch.tensor([3.0, 4.0, 5.0]).double()
    context = Context(time, time.new_zeros(3, 0), (), torch.zeros(3, 1).double(), "V", ("y",))
    change = Periodic().change(torch.tensor([2.0, 3.0]).double(), {"period": 4.0}, context)
    torch.testing.assert_close(change[:, 0], torch.tensor([2.0, 3.0, -2.0]).double())
