"""The white noise of recorded samples: whatever the signal, or unknown."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from examples.concealed_physics.known import SHARED
from mkc_torch.diagnosis.noise.floor import white_noise
from tests.gate.fits import read_recording
from tests.gate.work import known_answers

N = 1500
WITHIN = 1.5
KNOWN = {
    "held_input": {"angle": 0.005}, "linear_input": {"angle": 0.005}, "pushed_slowly": {"angle": 0.005},
    "pushed_white": {"angle": 0.005}, "gusts": {"angle": 0.005}, "coloured_sensor white": {"altitude": 0.4},
    "coloured_sensor w2": {"altitude": 2.0}, "altitude": {"height": 0.006}, "heater": {"temp": 0.15},
    "wrong_sign": {"angle": 0.004}, "two_mass": {"angle": 0.003, "speed": 0.055},
}  # fmt: skip
"""Simulated recordings with the standard deviations of their noise, by output."""


def generator(seed):
    return torch.Generator().manual_seed(seed)


def randn(count, seed=0):
    return torch.randn(count, generator=generator(seed), dtype=torch.float64)


def floor_of(values, time=None, rounding=0.0, recorded=None):
    time = torch.arange(len(values), dtype=torch.float64) if time is None else time
    mask = None if recorded is None else recorded.unsqueeze(-1)
    return float(white_noise(values.unsqueeze(-1), time, torch.tensor([rounding]), mask))


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    period=st.floats(40.0, 2000.0),
    size=st.floats(1e-9, 1e9),
    noise=st.floats(0.001, 10.0),
    unit=st.floats(1e-6, 1e6),
)
def test_the_noise_on_a_swing_is_found_in_any_unit_and_scale_of_time(seed, period, size, noise, unit):
    steps = torch.arange(N, dtype=torch.float64)
    values = size * (torch.sin(2.0 * math.pi * steps / period) + noise * randn(N, seed))
    assert floor_of(values, unit * steps) == pytest.approx(size * noise, rel=0.15)


@given(seed=st.integers(0, 10**6), period=st.floats(6.0, 40.0), noise=st.floats(0.001, 10.0))
@settings(max_examples=25, deadline=None)
def test_samples_that_are_slow_for_the_signal_show_its_noise_or_none(seed, period, noise):
    found = floor_of(torch.sin(2.0 * math.pi * torch.arange(N) / period).double() + noise * randn(N, seed))
    assert math.isnan(found) or noise / WITHIN <= found <= noise * WITHIN


@pytest.mark.parametrize("seed", range(10))
def test_a_random_walk_and_slow_noise_have_no_white_noise(seed):
    walk, slow = randn(N, seed).cumsum(0), torch.as_tensor(lfilter([1.0], [1.0, -0.95], randn(N, seed).numpy()))
    assert math.isnan(floor_of(walk))
    assert math.isnan(floor_of(slow))
    # white noise that is larger than the steps of the walk is seen
    assert floor_of(walk + 5.0 * randn(N, seed + 100)) == pytest.approx(5.0, rel=0.15)


@pytest.mark.parametrize("share", [0.0, 0.03])
def test_outliers_uneven_sampling_gaps_and_missing_values_keep_the_size(share):
    chosen = torch.rand(N, generator=generator(3)) < share
    steps = 0.5 + torch.rand(N, generator=generator(4), dtype=torch.float64)
    time = steps.cumsum(0)
    time[700:] += 400.0
    values = torch.sin(time / 15.0) + 0.02 * randn(N) + 3.0 * chosen * randn(N, 5)
    recorded = torch.rand(N, generator=generator(6)) < 0.9
    holes = torch.where(recorded, values, torch.nan)
    for found in (floor_of(values, time), floor_of(holes, time), floor_of(values, time, recorded=recorded)):
        assert found == pytest.approx(0.02, rel=0.3 if share else 0.12)


def test_a_second_run_does_not_count_as_noise():
    steps = torch.arange(40, dtype=torch.float64).repeat(30)
    values = torch.sin(steps / 9.0) + 50.0 * torch.arange(30).repeat_interleave(40) + 0.01 * randn(1200)
    assert floor_of(values, steps) == pytest.approx(0.01, rel=0.1)


def test_too_few_samples_show_no_noise():
    assert math.isnan(floor_of(randn(31)))
    assert floor_of(randn(60)) == pytest.approx(1.0, rel=0.4)
    assert math.isnan(float(white_noise(randn(0).unsqueeze(-1), randn(0), torch.zeros(1))))


def test_rounding_is_the_least():
    swing = torch.sin(torch.arange(N, dtype=torch.float64) / 60.0)
    rounded = (swing * 100.0).round() / 100.0
    assert floor_of(rounded, rounding=0.01 / 12.0**0.5) == pytest.approx(0.01 / 12.0**0.5, rel=0.3)
    constant = torch.full((N,), 3.0, dtype=torch.float64)
    assert floor_of(constant, rounding=0.25) == 0.25
    assert floor_of(constant) == 0.0


@pytest.mark.parametrize("case", list(KNOWN))
def test_the_noise_of_simulated_recordings_is_within_a_factor_or_unknown(case):
    jobs = [known for known in known_answers(("cases", "strangers")) if case in known.name]
    if not jobs:
        pytest.skip(f"no recording of {case} in {SHARED / 'cases'}")
    for job in jobs:
        recording = read_recording(job.recording, job.request)
        for name, size in KNOWN[case].items():
            found = floor_of(recording[name].double(), recording["time"].double())
            assert math.isnan(found) or size / WITHIN <= found <= size * WITHIN
