"""The least-squares periodogram against SciPy and NumPy, and its level of noise."""

import numpy as np
import pytest
import torch
from scipy import signal, stats

from mkc_torch.diagnosis.noise.periodogram import (
    drawn_noise,
    evidence,
    level_error,
    log_level,
    powers,
    quiet_level,
    slow_basis,
    without_lines,
)
from mkc_torch.effects.periodic import frequencies


def uneven(seed, N=200):
    r = np.random.default_rng(seed)
    time = np.sort(r.uniform(0.0, 50.0, N))
    return r, torch.tensor(time[(time < 18.0) | (time > 27.0)])


def test_powers_equal_scipys_lomb_scargle_periodogram_of_uneven_times_with_a_gap():
    r, time = uneven(0)
    series = r.normal(size=len(time))
    grid = frequencies(time)
    found = powers(time, torch.ones_like(time), time.new_zeros(len(time), 0), torch.tensor(series)[:, None], grid)
    known = signal.lombscargle(time.numpy() - float(time[0]), series, 2.0 * np.pi * grid.numpy())
    np.testing.assert_allclose(found[:, 0].numpy(), 2.0 * known, rtol=1e-8)


def test_powers_next_to_parameters_and_masked_samples_equal_least_squares():
    r, time = uneven(1)
    counts = torch.tensor((r.uniform(size=len(time)) > 0.1).astype(float))
    tangents = torch.tensor(r.normal(size=(len(time), 2)))
    series = torch.tensor(r.normal(size=(len(time), 1)))
    basis = slow_basis(time, counts, tangents)
    frequency = torch.tensor([0.3, 1.1]).double()
    found = powers(time, counts, basis, series, frequency)[:, 0]
    rows = counts.numpy() > 0
    y = series.numpy()[rows, 0]
    phase = np.pi * (time.numpy() - float(time[0])) / float(time[-1] - time[0])
    own = np.concatenate([np.cos(phase[:, None] * np.arange(8)), tangents.numpy()], -1)[rows]

    def left(columns):
        return np.square(y - columns @ np.linalg.lstsq(columns, y, rcond=None)[0]).sum()

    for value, at in zip(found.tolist(), frequency.tolist(), strict=True):
        angle = 2.0 * np.pi * at * time.numpy()[rows]
        more = np.concatenate([own, np.cos(angle)[:, None], np.sin(angle)[:, None]], -1)
        assert value == pytest.approx(left(own) - left(more), rel=1e-8)


def test_without_lines_leaves_no_power_at_a_frequency_of_each_series():
    r, time = uneven(2)
    counts, basis = torch.ones_like(time), slow_basis(time, torch.ones_like(time), time.new_zeros(len(time), 0))
    series, frequency = torch.tensor(r.normal(size=(len(time), 2))), torch.tensor([0.4, 0.9]).double()
    left = powers(time, counts, basis, without_lines(time, counts, basis, series, frequency), frequency)
    assert float(left.diagonal().max()) < 1e-18
    assert float(left[0, 1]) > 1e-3


def test_level_of_white_noise_is_its_power_and_has_the_stated_error():
    time = torch.arange(600).double()
    noise = torch.randn(600, 60, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    grid = frequencies(time)
    basis = slow_basis(time, torch.ones_like(time), time.new_zeros(600, 0))
    power = powers(time, torch.ones_like(time), basis, noise, grid)
    level = log_level(power, grid)
    assert float(level.mean()) == pytest.approx(np.log(2.0), abs=0.05)
    ratio = level.std(-1) / level_error(grid)
    assert 0.8 < float(ratio[::40].mean()) < 1.2
    assert float(level_error(grid)[0]) > 1.5 * float(level_error(grid)[len(grid) // 2])
    assert float(quiet_level(power, grid).mean()) == pytest.approx(np.log(2.0), abs=0.15)


def test_a_line_raises_the_quiet_level_far_less_than_its_own_power():
    time = torch.arange(600).double()
    grid = frequencies(time)
    waves = sum(torch.sin(2.0 * np.pi * f * time) for f in (0.1, 0.11, 0.12, 0.13))
    series = 30.0 * waves + torch.randn(600, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    power = powers(time, torch.ones_like(time), time.new_zeros(600, 0), series[:, None], grid)
    place = int((grid - 0.11).abs().argmin())
    assert float(power[place].log() - quiet_level(power, grid)[place]) > 4.0


def test_evidence_equals_the_probability_by_numerical_integration():
    for excess, error in ((1.5, 0.3), (2.5, 0.5)):
        z = np.linspace(-8.0, 8.0, 20_001)
        tail = np.exp(-np.exp(excess + error * z)) * stats.norm.pdf(z)
        known = -np.log(np.trapezoid(tail, z))
        found = evidence(torch.tensor([[excess]]).double(), torch.tensor([error]).double())
        assert float(found) == pytest.approx(known, rel=0.05)


def test_drawn_noise_has_the_given_spectrum_at_uneven_times():
    time = torch.arange(800).double()
    time = torch.cat([time[:300], time[420:]])
    grid = frequencies(time)
    wanted = torch.where(grid < 0.2, 3.0, 0.0)
    noise = drawn_noise(time, wanted, grid, 40, torch.Generator().manual_seed(0))
    power = powers(time, torch.ones_like(time), time.new_zeros(len(time), 0), noise, grid).mean(-1).log()
    step = power[grid < 0.17].mean() - power[grid > 0.23].mean()
    assert float(step) == pytest.approx(3.0, abs=0.2)
