"""The first-order lag, against SciPy's filter and the differential equation."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.signal import cont2discrete, lfilter, lfiltic

from mkc_torch.effects.waveforms import lagged

RANDOM = np.random.default_rng(4)


@pytest.mark.parametrize("N", [2, 3, 64, 65, 1000])
@pytest.mark.parametrize("lag", [1e-3, 0.3, 5.0, 1e4])
def test_lagged_even_samples_agree_with_scipy(N, lag):
    x = RANDOM.standard_normal(N).cumsum() + 20.0
    system = cont2discrete(([1.0 / lag], [1.0, 1.0 / lag]), 0.02, method="foh")
    b, a = system[0].ravel(), system[1]
    expected = lfilter(b, a, x, zi=lfiltic(b, a, y=[x[0]], x=[x[0]]))[0]
    found = lagged(torch.from_numpy(x), 0.02 * torch.arange(N, dtype=torch.float64), lag)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_lagged_uneven_samples_solve_the_differential_equation():
    time = np.cumsum(0.3 * RANDOM.random(40) + 0.01)
    x = RANDOM.standard_normal(40)
    y = [x[0]]
    for k in range(1, 40):
        solution = solve_ivp(
            lambda t, y, k=k: (np.interp(t, time[k - 1 : k + 1], x[k - 1 : k + 1]) - y) / 0.7,
            (time[k - 1], time[k]),
            [y[-1]],
            rtol=1e-10,
            atol=1e-12,
        )
        y.append(solution.y[0, -1])
    found = lagged(torch.from_numpy(x), torch.from_numpy(time), 0.7)
    np.testing.assert_allclose(found, y, atol=1e-8)


def test_the_lagged_signal_after_a_long_gap_does_not_depend_on_the_past():
    time = torch.tensor([0.0, 1.0, 1001.0, 1002.0], dtype=torch.float64)
    found = lagged(torch.tensor([5.0, 5.0, 2.0, 2.0], dtype=torch.float64), time, 1.0)
    late = 3.0 / 1000.0  # behind the straight line through the gap
    assert found.tolist() == pytest.approx([5.0, 5.0, 2.0 + late, 2.0 + late / np.e], abs=1e-12)


def test_a_lag_of_zero_changes_nothing():
    x = torch.from_numpy(RANDOM.standard_normal(5))
    assert torch.equal(lagged(x, torch.arange(5.0, dtype=torch.float64), 0.0), x)


def test_samples_at_the_same_time_are_a_step():
    time = torch.tensor([0.0, 1.0, 1.0, 2.0], dtype=torch.float64)
    found = lagged(torch.tensor([0.0, 0.0, 4.0, 4.0], dtype=torch.float64), time, 1.0)
    assert found.tolist() == pytest.approx([0.0, 0.0, 0.0, 4.0 * (1.0 - np.exp(-1.0))], abs=1e-9)


def test_the_derivative_by_the_lag_agrees_with_differences():
    time = torch.cat([torch.linspace(0.0, 3.0, 30, dtype=torch.float64), torch.tensor([3.0, 3.5]).double()])
    values = torch.sin(2.0 * time)
    for size in (0.05, 0.5, 20.0):
        lag = torch.tensor(size, dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(lambda size: lagged(values, time, size), (lag,), check_forward_ad=True)


def test_the_derivative_by_the_values_agrees_with_differences():
    time = torch.linspace(0.0, 3.0, 50, dtype=torch.float64)
    values = torch.sin(time).requires_grad_()
    assert torch.autograd.gradcheck(lambda v: lagged(v, time, 0.5), (values,))
