"""Lines in residuals: found in noise of any colour, and not where a signal or a resonance can be the cause."""

import numpy as np
import pytest
import torch
from scipy.signal import lfilter

from mkc_torch.diagnosis.search.lines import line_of

TIME = 0.1 * np.arange(600)
PERIOD = 3.37


def search(residual, output, signals=(), time=TIME, tangents=None, draws=99):
    residual = torch.tensor(np.array(residual))[:, None]
    tangents = torch.ones(len(time), 1, 1).double() if tangents is None else torch.tensor(tangents)[:, None]
    return line_of(
        torch.tensor(time),
        residual,
        torch.ones_like(residual),
        tangents,
        torch.tensor(output)[:, None],
        [torch.tensor(values) for values in signals],
        draws=draws,
        generator=torch.Generator().manual_seed(0),
    )


def broad(r, N=600):
    return lfilter([1.0], [1.0, -0.9], r.normal(size=N + 300))[300:]


def is_significant(line):
    return line is not None and line.p_value <= 0.05


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("colour", "size"), [("white", 0.8), ("autoregressive", 4.0), ("walk", 5.0)])
def test_a_line_is_found_in_noise_of_each_colour(seed, colour, size):
    r = np.random.default_rng(seed)
    white = r.normal(size=600)
    noise = {"white": white, "autoregressive": broad(r), "walk": np.cumsum(white)}[colour]
    line = search(noise + size * np.sin(2.0 * np.pi * TIME / PERIOD + seed), broad(r))
    assert is_significant(line)
    assert abs(1.0 / line.frequency - PERIOD) < 0.03


def test_a_line_is_found_over_a_gap_at_uneven_times():
    r = np.random.default_rng(5)
    time = np.sort(r.uniform(0.0, 90.0, 700))
    time = time[(time < 30.0) | (time > 52.0)]
    N = len(time)
    line = search(r.normal(size=N) + 0.8 * np.sin(2.0 * np.pi * time / PERIOD), broad(r, N), time=time)
    assert is_significant(line)
    assert abs(1.0 / line.frequency - PERIOD) < 0.02


def test_noise_of_each_colour_and_a_resonance_seldom_have_a_line():
    alarms = 0
    for seed in range(8):
        r = np.random.default_rng(seed)
        white = r.normal(size=900)
        resonance = lfilter([1.0], [1.0, -2.0 * 0.985 * np.cos(0.44), 0.985**2], white)[300:]
        for noise in (white[300:], np.cumsum(white)[300:], resonance):
            alarms += is_significant(search(noise, broad(r)))
    assert alarms <= 3  # of 24


ERRORS = {
    "gain": lambda make: 0.2 * make(TIME),
    "clock": lambda make: make(TIME + 0.3) - make(TIME),
    "lag": lambda make: make(TIME) - lfilter([0.12], [1.0, -0.88], make(TIME)),
    "sign": lambda make: -2.0 * make(TIME),
    "friction": lambda make: 0.2 * np.sign(make(TIME)),
    "dead zone": lambda make: -np.clip(make(TIME), -0.3, 0.3),
}

INPUTS = {
    "sine": lambda t: np.sin(2.0 * np.pi * t / PERIOD),
    "square": lambda t: np.sign(np.sin(2.0 * np.pi * t / PERIOD)),
    "two": lambda t: np.sin(2.0 * np.pi * t / PERIOD) + 0.4 * np.sin(0.7 * t + 1.0),
}


def test_an_error_of_the_response_to_a_periodic_input_is_no_line():
    noise = 0.02 * np.random.default_rng(0).normal(size=600)
    found = [
        (name, error)
        for name, make in INPUTS.items()
        for error, changed in ERRORS.items()
        if is_significant(search(changed(make) + noise, make(TIME)))
    ]
    assert len(found) <= 1, found  # of 18, at a level of 5 %


def test_a_line_that_a_recorded_column_has_is_left_out_and_another_is_found():
    r = np.random.default_rng(3)
    output, wave = broad(r), np.sin(2.0 * np.pi * TIME / PERIOD)
    residual = r.normal(size=600) + 0.8 * wave
    assert is_significant(search(residual, output))
    assert not is_significant(search(residual, output, [2.0 + 5.0 * np.roll(wave, 7)]))
    other = search(residual + 0.8 * np.sin(2.0 * np.pi * TIME / 0.83), output, [wave])
    assert is_significant(other)
    assert abs(1.0 / other.frequency - 0.83) < 0.01


def test_a_line_far_larger_than_the_outputs_own_is_found():
    wave = np.sin(2.0 * np.pi * TIME / PERIOD)
    r = np.random.default_rng(0)
    noise, output = 0.1 * r.normal(size=600), 0.2 * broad(r)
    assert not is_significant(search(0.9 * wave + noise, wave + output))
    assert is_significant(search(9.0 * wave + noise, np.cos(2.0 * np.pi * TIME / PERIOD) + output))


def test_no_line_is_sought_in_runs_with_clocks_of_their_own_or_in_few_samples():
    r = np.random.default_rng(0)
    time = np.concatenate([TIME[:300], TIME[:300]])
    assert search(r.normal(size=600) + np.sin(2.0 * time), broad(r), time=time) is None
    assert search(r.normal(size=30), broad(r, 30), time=TIME[:30]) is None


def test_the_p_value_without_draws_is_that_of_independent_frequencies():
    r = np.random.default_rng(2)
    line = search(r.normal(size=600) + 0.6 * np.sin(2.0 * np.pi * TIME / PERIOD), broad(r), draws=0)
    assert line.p_value == pytest.approx(284 * np.exp(-line.evidence), rel=0.05)
    assert search(r.normal(size=600), broad(r), draws=0).p_value > 0.2
