"""Inputs between samples, against closed forms."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mkc_torch.simulation.dynamics.between_samples import inputs_between, smooth_between
from mkc_torch.simulation.ports import SignalTimes


def clock_of(time, begins, share):
    """Return times in each interval of a run, at this share of the interval."""
    before = torch.arange(len(time) - 1)[~begins[1:]]
    shares = torch.full((len(before),), share, dtype=torch.float64)
    return SignalTimes(torch.lerp(time[before], time[before + 1], shares), before, before + 1, shares)


def runs_of(*lengths, seed=0):
    """Irregular times of several runs, and the mask of their starts."""
    random = np.random.default_rng(seed)
    time = torch.from_numpy(np.concatenate([np.cumsum(random.uniform(0.5, 1.5, n)) for n in lengths]))
    return time, torch.cat([torch.arange(n) == 0 for n in lengths])


@pytest.mark.parametrize("share", [0.0, 0.25, 0.5, 0.75])
def test_held_and_linear_interpolation_match_their_definitions(share):
    time, begins = runs_of(7, 9)
    values = torch.stack([time.sin(), time.square()], -1)
    clock = clock_of(time, begins, share)
    assert torch.equal(inputs_between(values, "held", time, begins, clock), values[clock.before])
    line = values[clock.before] * (1.0 - share) + values[clock.after] * share
    torch.testing.assert_close(inputs_between(values, "linear", time, begins, clock), line)
    smooth = inputs_between(values, "smooth", time, begins, clock)
    assert torch.equal(smooth, smooth_between(values, time, begins, clock))
    assert share == 0.0 or float((smooth - line).abs().max()) > 0.01


@given(
    coefficients=st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6),
    lengths=st.lists(st.integers(6, 15), min_size=1, max_size=3),
    share=st.floats(0.0, 1.0),
)
@settings(max_examples=25, deadline=None, derandomize=True)
def test_smooth_interpolation_reproduces_polynomials_of_fifth_degree_in_each_run(coefficients, lengths, share):
    time, begins = runs_of(*lengths)
    run = begins.long().cumsum(0)

    def course(t, number):
        # a different polynomial in each run, far from those of its neighbours
        x = t / 5.0
        return sum(c * x**k for k, c in enumerate(coefficients)) * number + 1e3 * number

    clock = clock_of(time, begins, share)
    found = smooth_between(course(time, run).unsqueeze(-1), time, begins, clock)
    expected = course(clock.time, run[clock.before]).unsqueeze(-1)
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-6)


def test_interpolation_at_the_samples_returns_the_samples():
    time, begins = runs_of(12, 8)
    values = torch.randn(20, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for how in ("held", "linear", "smooth"):
        clock = clock_of(time, begins, 0.0)
        torch.testing.assert_close(inputs_between(values, how, time, begins, clock), values[clock.before])


@pytest.mark.parametrize("length", [2, 3, 5])
def test_runs_of_fewer_than_six_samples_are_interpolated_linearly(length):
    time, begins = runs_of(10, length, 10)
    values = (time / 5.0).pow(3).unsqueeze(-1)
    clock = clock_of(time, begins, 0.5)
    short = (clock.before >= 10) & (clock.before < 10 + length)
    found = smooth_between(values, time, begins, clock)
    torch.testing.assert_close(found[short], clock.at(values)[short])
    torch.testing.assert_close(found[~short, 0], (clock.time[~short] / 5.0).pow(3), rtol=1e-9, atol=1e-9)
    assert float((clock.at(values)[:, 0] - (clock.time / 5.0).pow(3)).abs().min()) > 1e-3
