"""Periodic disturbances: the grid of frequencies, the waveform and its texts."""

import numpy as np
import pytest
import torch

from mkc_torch.effects import Context
from mkc_torch.effects.periodic import Periodic, PeriodicRate, frequencies


def context(time):
    return Context(time, time.new_zeros(len(time), 0), (), torch.zeros(len(time), 1).double(), "V", ("y",))


def explained(time, wave, frequency):
    columns = np.stack([np.cos(2.0 * np.pi * frequency * time), np.sin(2.0 * np.pi * frequency * time)], -1)
    left = wave - columns @ np.linalg.lstsq(columns, wave, rcond=None)[0]
    return 1.0 - left @ left / (wave @ wave)


def test_a_sinusoid_between_two_frequencies_of_the_grid_keeps_nine_tenths_of_its_power():
    r = np.random.default_rng(1)
    time = np.sort(r.uniform(0.0, 40.0, 300))
    time = time[(time < 12.0) | (time > 21.0)]  # a gap
    grid = frequencies(torch.tensor(time)).tolist()
    for frequency in r.uniform(grid[0], grid[-1], 8):
        wave = np.sin(2.0 * np.pi * frequency * time + r.uniform(0.0, 6.0))
        assert max(explained(time, wave, tried) for tried in grid) > 0.9


def test_frequencies_begin_at_four_cycles_and_end_below_half_of_the_sampling_rate():
    grid = frequencies(torch.arange(101).double() / 10.0)
    assert float(grid[0]) * 10.0 == pytest.approx(4.0)
    assert 4.9 < float(grid[-1]) < 5.0
    assert len(frequencies(torch.zeros(5))) == 0
    assert len(frequencies(torch.arange(200_000))) == 16_384


@pytest.mark.parametrize("effect", [Periodic(), PeriodicRate()])
def test_change_is_a_cosine_and_a_sine_since_the_start(effect):
    time = torch.linspace(3.0, 9.0, 50).double()
    change = effect.change(torch.tensor([2.0, 3.0]).double(), {"period": 4.0, "start": 3.0}, context(time))
    phase = np.pi / 2.0 * (time.numpy() - 3.0)
    np.testing.assert_allclose(change[:, 0].numpy(), 2.0 * np.cos(phase) + 3.0 * np.sin(phase), atol=1e-12)


def test_texts_have_period_amplitude_and_the_name_of_a_known_period():
    time = torch.arange(0.0, 10 * 86400.0, 600.0).double()
    shape = {"period": 86_390.0, "start": 0.0}
    effect = Periodic()
    text = effect.explained([3.0, 4.0], shape, context(time))
    assert "amplitude 5 V" in text
    assert "repeats through the whole recording" in text
    assert effect.advised([3.0, 4.0], shape, context(time)).startswith("The period is that of a day.")
    assert effect.advised([3.0, 4.0], shape | {"period": 70_000.0}, context(time)) == effect.advice
    fast = torch.arange(0.0, 4.0, 0.001).double()
    assert "mains at 50 Hz" in effect.advised([1.0, 0.0], {"period": 0.0201, "start": 0.0}, context(fast))
    assert "mains at 60 Hz" in effect.advised([1.0, 0.0], {"period": 1.0 / 60.1, "start": 0.0}, context(fast))
