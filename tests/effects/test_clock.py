"""Signals read by a clock of another rate, compared with SciPy's cubic Hermite splines and with the signal itself."""

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicHermiteSpline

from mkc_torch.effects import resampled
from mkc_torch.effects.dynamics.sensor_clock_drift import CommonClockDrift, SensorClockDrift
from tests.effects.contexts import dynamic_context


def uneven(N=200, start=3.0):
    steps = np.random.default_rng(4).uniform(0.03, 0.07, N)
    return torch.from_numpy(start + np.cumsum(steps))


@pytest.mark.parametrize("rate", [0.0, 0.004, 0.2])
def test_a_fast_clock_reads_a_cubic_spline_with_the_slopes_of_parabolas(rate):
    time = uneven()
    values = torch.sin(2.0 * time)
    spline = CubicHermiteSpline(time, values, np.gradient(values.numpy(), time.numpy(), edge_order=2))
    at = time[0] + (time - time[0]) / (1.0 + rate)
    np.testing.assert_allclose(resampled(values, time, rate).numpy(), spline(at.numpy()), rtol=0.0, atol=1e-12)


def test_a_slow_clock_continues_beyond_the_end_with_the_slope_there():
    time = uneven()
    found = resampled(5.0 - 2.0 * time, time, -0.1)
    torch.testing.assert_close(found, 5.0 - 2.0 * (time[0] + (time - time[0]) / 0.9))


def test_the_error_between_samples_falls_with_the_third_power_of_the_step():
    def error(step):
        time = torch.arange(0.0, 20.0, step, dtype=torch.float64)
        return float((resampled(torch.sin(time), time, 0.013) - torch.sin(time / 1.013)).abs()[5:].amax())

    assert error(0.1) < error(0.2) / 7.0
    assert error(0.2) < 5e-4


@pytest.mark.parametrize("later", [0.13, -0.13])
def test_a_shift_is_that_of_the_signal(later):
    time = uneven()
    found = resampled(torch.sin(time), time, 0.0, later=later)
    torch.testing.assert_close(found[5:-5], torch.sin(time + later)[5:-5], rtol=0.0, atol=1e-4)
    line = resampled(1.0 - 3.0 * time, time, 0.0, later=later)
    torch.testing.assert_close(line, 1.0 - 3.0 * (time + later))


def test_each_run_starts_its_clock_again():
    one, other = uneven(50), uneven(30, start=1.0)
    time, run = torch.cat([one, other]), torch.cat([torch.zeros(50), torch.ones(30)]).long()
    both = resampled(torch.cos(time), time, 0.02, run)
    torch.testing.assert_close(both, torch.cat([resampled(torch.cos(t), t, 0.02) for t in (one, other)]))
    torch.testing.assert_close(both, resampled(torch.cos(time), time, 0.02))  # time goes back


@pytest.mark.parametrize("count", [1, 2])
def test_runs_of_one_or_two_samples_are_read_along_a_line(count):
    time = torch.arange(float(count), dtype=torch.float64)
    torch.testing.assert_close(resampled(1.0 + 3.0 * time, time, 0.5), 1.0 + 2.0 * time)


@pytest.mark.parametrize("rate", [0.01, -0.01])
def test_derivatives_by_rate_and_values_are_correct(rate):
    time = uneven(40)
    values = torch.sin(3.0 * time).requires_grad_()
    size = torch.tensor(rate, dtype=torch.float64, requires_grad=True)
    arguments = values, size
    assert torch.autograd.gradcheck(lambda y, r: resampled(y, time, r), arguments, check_forward_ad=True)


def test_a_clock_of_one_output_leaves_the_other():
    context = dynamic_context(SensorClockDrift())
    signal = torch.stack([torch.sin(context.time), torch.cos(context.time)], -1)
    two = type(context)(context.time, context.drivers, (), signal, "N", ("force", "speed"))
    gamma = torch.tensor([0.0, 0.8], dtype=torch.float64)
    changed = SensorClockDrift().change(gamma, {}, two)
    assert not bool(changed[:, 0].any())
    torch.testing.assert_close(changed[:, 1], CommonClockDrift().change(gamma[1:], {}, two)[:, 1])
    text = SensorClockDrift().explained([0.0, 0.8], {}, two)
    assert text == "The clock of output `speed` runs 0.8 % fast relative to the clock of the inputs."
    assert "`force` and `speed` runs 0.8 % slow" in CommonClockDrift().explained([-0.8], {}, two)
