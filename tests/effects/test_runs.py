"""Recurrences along samples, against loops and a differential equation."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from mkc_torch.effects.hysteresis import hysteretic_path
from mkc_torch.effects.paired.between import shifted
from mkc_torch.effects.runs import clamped_recurrence, linear_recurrence
from mkc_torch.effects.waveforms import lagged, played, rate_limited

RANDOM = np.random.default_rng(11)
TIME = torch.arange(60, dtype=torch.float64)


@pytest.mark.parametrize("dtype", [torch.float64, torch.complex128])
def test_recurrence_has_the_derivatives_of_a_loop(dtype):
    generator = torch.Generator().manual_seed(0)
    factor, level = (0.5 * torch.randn(9, dtype=dtype, generator=generator) for _ in range(2))
    factor[4] = 0.0
    inputs = (factor.requires_grad_(), level.requires_grad_())
    assert torch.autograd.gradcheck(linear_recurrence, inputs, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(linear_recurrence, inputs)
    assert torch.autograd.gradcheck(
        lambda values: linear_recurrence(factor.detach(), values), inputs[1], check_forward_ad=True
    )


def test_recurrence_has_tangents_under_vmap():
    generator = torch.Generator().manual_seed(0)
    factor, level = (0.5 * torch.randn(9, 4, dtype=torch.float64, generator=generator) for _ in range(2))

    def moved(theta):
        return linear_recurrence(torch.tanh(factor @ theta), torch.sin(level @ theta))

    theta = torch.randn(4, dtype=torch.float64, generator=generator)
    forward, reverse = torch.func.jacfwd(moved)(theta), torch.func.jacrev(moved)(theta)
    torch.testing.assert_close(forward, reverse)
    step = 1e-6 * torch.eye(4, dtype=torch.float64)
    differences = [(moved(theta + change) - moved(theta - change)) / 2e-6 for change in step]
    torch.testing.assert_close(forward, torch.stack(differences, -1), rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(
        torch.func.vmap(linear_recurrence, 1, 1)(factor, level)[:, 2], linear_recurrence(factor[:, 2], level[:, 2])
    )


@pytest.mark.parametrize("N", [1, 2, 3, 64, 65, 300])
def test_scans_equal_loops(N):
    factor, level = torch.from_numpy(RANDOM.uniform(-1.0, 1.0, (2, N)))
    low = torch.from_numpy(RANDOM.standard_normal(N).cumsum())
    high = low + torch.from_numpy(RANDOM.uniform(0.0, 2.0, N))
    low[0] = high[0]
    y, z, affine, within = 0.0, float(low[0]), [], []
    for k in range(N):
        y = float(factor[k]) * y + float(level[k])
        z = max(float(low[k]), min(float(high[k]), z))
        affine.append(y)
        within.append(z)
    np.testing.assert_allclose(linear_recurrence(factor, level), affine, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(clamped_recurrence(low, high), within, rtol=0, atol=0)


def test_play_has_memory():
    there = torch.linspace(0.0, 3.0, 31, dtype=torch.float64)
    back = played(torch.cat([there, there.flip(0)]), torch.arange(62.0), 0.5)
    assert back[20].item() == pytest.approx(1.5)
    assert back[41].item() == pytest.approx(2.5)  # at the same input on the way back
    assert float((back[31:36] - 2.5).abs().max()) < 1e-12  # it crosses the gap


@pytest.mark.parametrize("N", [40, 41])
def test_played_equals_the_play_operator(N):
    u = RANDOM.standard_normal(N).cumsum()
    y = [u[0]]
    for value in u[1:]:
        y.append(max(value - 0.8, min(value + 0.8, y[-1])))
    np.testing.assert_allclose(played(torch.from_numpy(u), torch.arange(float(N)), 0.8), y, rtol=0, atol=1e-14)


def test_play_without_a_gap_changes_nothing():
    u = torch.from_numpy(RANDOM.standard_normal(20))
    assert torch.equal(played(u, torch.arange(20.0), 0.0), u)


def test_rate_limited_equals_the_limited_equation():
    """ẏ = ±r until y has reached its command, whatever the sampling intervals."""
    time = np.cumsum(RANDOM.uniform(0.001, 0.01, 800))
    u, rate = np.sin(3.0 * time) + 0.5 * np.sin(7.0 * time), 2.5
    fine = np.linspace(time[0], time[-1], 200_001)
    command, y = np.interp(fine, time, u), u[0]
    followed = []
    for value in command:
        y += np.clip(value - y, -rate * (fine[1] - fine[0]), rate * (fine[1] - fine[0]))
        followed.append(y)
    found = rate_limited(torch.from_numpy(u), torch.from_numpy(time), rate).numpy()
    exact = np.interp(time, fine, followed)
    assert 0.2 < np.mean(np.abs(exact - u) > 1e-2) < 0.8
    np.testing.assert_allclose(found, exact, rtol=0, atol=0.01)  # it meets its command between two samples


def test_a_limit_beyond_the_fastest_change_has_no_effect():
    u = torch.from_numpy(RANDOM.standard_normal(20))
    assert torch.equal(rate_limited(u, torch.arange(20.0), 10.0), u)


def test_the_largest_rate_is_differentiable():
    u = torch.from_numpy(RANDOM.standard_normal(20).cumsum())
    rate = torch.tensor(0.37, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda r: rate_limited(u, TIME[:20], r), (rate,), check_forward_ad=True)


@pytest.mark.parametrize("of", ["play", "rate limit", "hysteresis", "lag", "shift"])
def test_derivatives_in_all_modes(of):
    """In reverse and forward mode, and under vmap."""
    function = {
        "play": lambda v: played(v, TIME[:12], 0.7),
        "rate limit": lambda v: rate_limited(v, TIME[:12], 0.4),
        "hysteresis": lambda v: hysteretic_path(v, 0.7, torch.zeros(12, dtype=torch.long)),
        "lag": lambda v: lagged(v, TIME[:12], 3.0),
        "shift": lambda v: shifted(v, TIME[:12], -2.3),
    }[of]
    values = torch.from_numpy(RANDOM.standard_normal((3, 12)).cumsum(-1)).requires_grad_()
    assert torch.autograd.gradcheck(function, (values[0].detach().requires_grad_(),), check_forward_ad=True)
    together = torch.vmap(function)(values)
    torch.testing.assert_close(together, torch.stack([function(row) for row in values]))
    tangents = torch.vmap(lambda v: torch.func.jvp(function, (v,), (torch.ones_like(v),))[1])(values)
    assert bool(tangents.isfinite().all())


@pytest.mark.parametrize("yields", [0.05, 0.3, 2.0])
def test_hysteretic_path_solves_the_bouc_wen_equation(yields):
    time = np.linspace(0.0, 6.0, 3001)

    def rate(t, z):
        v = 1.3 * np.cos(1.3 * t) - 1.2 * np.sin(4.0 * t)
        return v - (abs(v) * z + v * abs(z)) / (2.0 * yields)

    exact = solve_ivp(rate, (0.0, 6.0), [0.0], t_eval=time, rtol=1e-9, atol=1e-10, max_step=0.005).y[0]
    x = np.sin(1.3 * time) + 0.3 * np.cos(4.0 * time)
    found = hysteretic_path(torch.from_numpy(x), yields, torch.zeros(3001, dtype=torch.long))
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-3 * yields)
    assert float(found.abs().max()) <= yields * (1.0 + 1e-9)


def test_a_hysteretic_loop_dissipates_energy():
    turn = torch.linspace(0.0, 2.0 * np.pi, 2001, dtype=torch.float64)
    x = torch.cat([turn.sin(), turn.sin()[1:]])
    z = hysteretic_path(x, 0.2, torch.zeros(4001, dtype=torch.long))
    work = (0.5 * (z[1:] + z[:-1]) * x.diff())[2000:].sum()
    assert float(work) > 0.5 * 4.0 * 0.2  # at least half of the largest area of a loop


def test_runs_are_separated_by_their_numbers():
    """On a common clock each run equals its separate evaluation."""
    values = torch.from_numpy(RANDOM.standard_normal(60).cumsum())
    run = torch.arange(3).repeat_interleave(20)
    for function in (
        lambda v, t, r: played(v, t, 0.5, r),
        lambda v, t, r: rate_limited(v, t, 0.2, r),
        lambda v, t, r: lagged(v, t, 4.0, r),
        lambda v, t, r: shifted(v, t, -3.7, r),
        lambda v, t, r: shifted(v, t, 3.7, r),
        lambda v, t, r: hysteretic_path(v, 0.5, torch.zeros_like(t, dtype=torch.long) if r is None else r),
    ):
        alone = [function(values[k : k + 20], TIME[k : k + 20], None) for k in (0, 20, 40)]
        torch.testing.assert_close(function(values, TIME, run), torch.cat(alone))


def test_a_run_of_one_sample_is_its_value():
    late = shifted(torch.tensor([1.0, 2.0, 9.0]), torch.tensor([0.0, 1.0, 2.0]), -0.5, torch.tensor([0, 0, 1]))
    assert late.tolist() == [1.0, 1.5, 9.0]
