"""Trajectories by collocation, against scipy's integrators, finite differences and closed forms."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from mkc_torch.simulation.dynamics.trajectory import Grid, solve, stations


def pendulum(x):
    return torch.stack([x[:, 1], -9.0 * torch.sin(x[:, 0])], -1)


def van_der_pol(x):
    return torch.stack([x[:, 1], 3.0 * (1.0 - x[:, 0] ** 2) * x[:, 1] - x[:, 0]], -1)


def mass_with_friction(x):
    """Return the rate of a mass on a spring with friction that is nearly a jump."""
    return torch.stack([x[:, 1], -x[:, 0] - 0.2 * torch.tanh(x[:, 1] / 0.001)], -1)


def reference(rate, start, time):
    """Return the trajectory by scipy at the given times."""

    def at(_, y):
        return rate(torch.from_numpy(y).unsqueeze(0))[0].numpy()

    tight = {"rtol": 1e-10, "atol": 1e-11}
    found = solve_ivp(at, (time[0], time[-1]), start, t_eval=time, method="LSODA", **tight)
    return torch.from_numpy(found.y.T.copy())


def perturbed(states, spread, seed=0):
    """Return a guess: the states with normal errors of this share of their size."""
    generator = torch.Generator().manual_seed(seed)
    return states + spread * states.abs().amax(0) * torch.randn(states.shape, generator=generator, dtype=states.dtype)


def grid_of(time):
    """Return the grid of a single trajectory."""
    return Grid(time, torch.arange(len(time)) == 0)


def even_times(end, count):
    return torch.linspace(0.0, end, count, dtype=torch.float64)


@pytest.mark.parametrize(
    ("rate", "end", "count", "within"),
    [(pendulum, 10.0, 401, 5e-6), (van_der_pol, 20.0, 1601, 1e-5), (mass_with_friction, 10.0, 2001, 1e-4)],
    ids=["pendulum", "van der Pol", "stiff friction"],
)
def test_trajectories_match_an_adaptive_integrator(rate, end, count, within):
    time = even_times(end, count)
    expected = reference(rate, [1.0, 0.0], time.numpy())
    found = solve(rate, grid_of(time), expected[:1], perturbed(expected, 0.01))
    assert found.converged
    assert float((found.states - expected).abs().max()) < within


def test_the_error_is_of_fourth_order():
    errors = []
    for count in (101, 201, 401):
        time = even_times(10.0, count)
        expected = reference(pendulum, [1.0, 0.0], time.numpy())
        errors.append(float((solve(pendulum, grid_of(time), expected[:1], expected).states - expected).abs().max()))
    ratios = np.array(errors[:-1]) / errors[1:]
    assert (ratios > 15.0).all()
    assert (ratios < 17.0).all()


def test_irregular_steps_are_accurate():
    generator = torch.Generator().manual_seed(1)
    time = (0.005 + 0.04 * torch.rand(400, generator=generator, dtype=torch.float64)).cumsum(0)
    expected = reference(pendulum, [1.0, 0.5], time.numpy())
    found = solve(pendulum, grid_of(time), expected[:1], perturbed(expected, 0.05))
    assert found.converged
    assert float((found.states - expected).abs().max()) < 2e-5


@given(
    coefficients=st.lists(st.floats(-5.0, 5.0), min_size=4, max_size=4),
    steps=st.lists(st.floats(1e-3, 2.0), min_size=1, max_size=12),
)
@settings(max_examples=30, deadline=None, derandomize=True)
def test_rates_that_are_cubics_of_time_are_integrated_exactly(coefficients, steps):
    time = torch.tensor([0.0, *steps], dtype=torch.float64).cumsum(0)
    grid = grid_of(time)

    def integral(t):
        return sum(c * t ** (k + 1) / (k + 1) for k, c in enumerate(coefficients)).unsqueeze(-1)

    stations = grid.stations
    course = sum(c * stations**k for k, c in enumerate(coefficients)).unsqueeze(-1)
    found = solve(lambda x: course + 0.0 * x, grid, torch.zeros(1, 1).double(), torch.zeros(len(time), 1).double())
    torch.testing.assert_close(found.states, integral(time), rtol=1e-10, atol=1e-10)


def test_stiff_decay_stays_bounded_at_steps_far_beyond_its_time_constant():
    time = even_times(10.0, 11)
    found = solve(lambda x: -1e6 * (x - 1.0), grid_of(time), torch.ones(1, 1).double(), torch.zeros(11, 1).double())
    assert found.converged
    torch.testing.assert_close(found.states, torch.ones(11, 1).double())


@pytest.fixture
def trajectories():
    """Trajectories of different length: their grid, initial states, guesses, and separate solutions."""
    pieces, guesses, alone = [], [], []
    starts = torch.tensor([[1.0, 0.0], [0.2, 2.0], [-0.5, 0.3]], dtype=torch.float64)
    for count, start in zip((120, 2, 57), starts, strict=True):
        time = even_times(0.02 * (count - 1), count) + 100.0 * count
        expected = reference(pendulum, start.numpy(), time.numpy())
        guess = perturbed(expected, 0.02)
        pieces.append(time)
        guesses.append(guess)
        alone.append(solve(pendulum, grid_of(time), start.unsqueeze(0), guess).states)
    begins = torch.cat([torch.arange(len(time)) == 0 for time in pieces])
    return Grid(torch.cat(pieces), begins), starts, torch.cat(guesses), torch.cat(alone)


def test_trajectories_in_a_grid_are_independent(trajectories):
    grid, starts, guess, alone = trajectories
    found = solve(pendulum, grid, starts, guess)
    assert found.converged
    assert grid.longest == 120
    torch.testing.assert_close(found.states, alone, rtol=1e-9, atol=1e-10)


def test_derivatives_by_other_trajectories_are_0(trajectories):
    grid, starts, guess, _ = trajectories
    slope = torch.func.jacfwd(lambda begin: solve(pendulum, grid, begin, guess).states)(starts)
    own = grid.begins.long().cumsum(0) - 1
    for k in range(3):
        assert float(slope[own != k][:, :, k].abs().max()) == 0.0
        assert float(slope[own == k][:, :, k].abs().max()) > 0.5


def test_a_single_interval_is_solved():
    grid = grid_of(torch.tensor([0.0, 0.1], dtype=torch.float64))
    begin = torch.ones(1, 1, dtype=torch.float64)
    found = solve(lambda x: -x, grid, begin, begin.expand(2, 1))
    assert found.converged
    assert stations(lambda x: -x, found.states, grid).shape == (3, 1)
    assert float(found.states[1]) == pytest.approx(np.exp(-0.1), rel=1e-7)


def test_stations_lie_on_the_trajectory():
    time = even_times(4.0, 201)
    expected = reference(pendulum, [1.0, 0.0], time.numpy())
    found = solve(pendulum, grid_of(time), expected[:1], expected)
    found_between = stations(pendulum, found.states, grid_of(time))
    between = reference(pendulum, [1.0, 0.0], np.linspace(0.0, 4.0, 401))[1::2]
    torch.testing.assert_close(found_between[1::3], between, rtol=0.0, atol=1e-5)
    torch.testing.assert_close(found_between[::3], found.states[:-1], rtol=0.0, atol=1e-12)
    torch.testing.assert_close(found_between[2::3], found.states[1:], rtol=0.0, atol=1e-12)


# derivatives: of a damped pendulum by its two parameters and its two first states

TIME = even_times(3.0, 121)
THETA = torch.tensor([9.0, 0.3, 1.0, -0.4], dtype=torch.float64)


def damped(theta, guess=None, known=None, time=TIME):
    guess = torch.zeros(len(time), 2, dtype=theta.dtype) if guess is None else guess

    def rate(x):
        return torch.stack([x[:, 1], -theta[0] * torch.sin(x[:, 0]) - theta[1] * x[:, 1]], -1)

    return solve(rate, grid_of(time), theta[2:].unsqueeze(0), guess, known)


@pytest.fixture(scope="module")
def solution():
    """Return the solution at ``THETA``, from which guesses are made."""

    def rate(x):
        return torch.stack([x[:, 1], -THETA[0] * torch.sin(x[:, 0]) - THETA[1] * x[:, 1]], -1)

    return reference(rate, THETA[2:].numpy(), TIME.numpy())


@pytest.fixture(scope="module")
def differences(solution):
    """Central finite differences, (G, n, 4)."""
    columns = []
    for direction in 1e-5 * torch.eye(4, dtype=torch.float64):
        ahead, behind = (damped(THETA + sign * direction, solution).states for sign in (1.0, -1.0))
        columns.append((ahead - behind) / 2e-5)
    return torch.stack(columns, -1)


@pytest.mark.parametrize("spread", [0.0, 0.05], ids=["from the answer", "from afar"])
class TestDerivatives:
    """Derivatives, from a near and from a far guess."""

    def test_jvp_agrees_with_finite_differences(self, solution, differences, spread):
        direction = torch.tensor([0.5, -1.0, 0.2, 0.7], dtype=torch.float64)
        guess = perturbed(solution, spread)
        states, slope = torch.func.jvp(lambda t: damped(t, guess).states, (THETA,), (direction,))
        torch.testing.assert_close(slope, differences @ direction, rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(states, damped(THETA, guess).states, rtol=1e-9, atol=1e-9)

    def test_jacfwd_agrees_with_finite_differences(self, solution, differences, spread):
        guess = perturbed(solution, spread)
        slope = torch.func.jacfwd(lambda t: damped(t, guess).states)(THETA)
        torch.testing.assert_close(slope, differences, rtol=1e-5, atol=1e-6)

    def test_vjp_is_the_transpose(self, solution, differences, spread):
        _, pull = torch.func.vjp(lambda t: damped(t, perturbed(solution, spread)).states, THETA)
        cotangents = torch.randn(3, 121, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        pulled = torch.vmap(lambda c: pull(c)[0])(cotangents)
        expected = torch.einsum("bgn,gnp->bp", cotangents, differences)
        torch.testing.assert_close(pulled, expected, rtol=1e-5, atol=1e-5)

    def test_derivatives_by_the_initial_states_only(self, solution, differences, spread):
        begin = THETA[2:].clone().requires_grad_()
        states = damped(torch.cat([THETA[:2], begin]), perturbed(solution, spread)).states
        (slope,) = torch.autograd.grad(states[-1, 0], begin)
        torch.testing.assert_close(slope, differences[-1, 0, 2:], rtol=1e-5, atol=1e-6)

    def test_derivatives_by_the_initial_states_of_a_constant_rate(self, solution, differences, spread):
        def rate(x):
            return torch.stack([x[:, 1], -THETA[0] * torch.sin(x[:, 0]) - THETA[1] * x[:, 1]], -1)

        begin = THETA[2:].clone().requires_grad_()
        states = solve(rate, grid_of(TIME), begin.unsqueeze(0), perturbed(solution, spread)).states
        (slope,) = torch.autograd.grad(states[-1, 0], begin)
        torch.testing.assert_close(slope, differences[-1, 0, 2:], rtol=1e-5, atol=1e-6)


def test_gradients_pass_gradcheck():
    time = even_times(0.5, 11)
    guess = damped(THETA, torch.tensor([[1.0, -0.4]]).double().expand(11, 2), time=time).states.detach()
    theta = THETA.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda t: damped(t, perturbed(guess, 0.02), time=time).states, (theta,))


def test_the_solution_does_not_depend_on_the_guess(solution):
    found = [damped(THETA, perturbed(solution, spread, seed)) for seed, spread in enumerate((0.0, 0.02, 0.1))]
    assert all(trajectory.converged for trajectory in found)
    for other in found[1:]:
        torch.testing.assert_close(other.states, found[0].states, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("away", [0.0, 1e-4, 0.05, 0.5], ids=str)
def test_a_known_linearisation_changes_neither_states_nor_derivatives(solution, differences, away):
    other = damped((1.0 + away) * THETA, solution)
    assert other.converged
    found = damped(THETA, other.states, other)
    assert found.converged
    torch.testing.assert_close(found.states, damped(THETA, solution).states, rtol=0.0, atol=1e-9)
    slope = torch.func.jacfwd(lambda t: damped(t, other.states, other).states)(THETA)
    torch.testing.assert_close(slope, differences, rtol=1e-5, atol=1e-6)


def test_a_known_linearisation_saves_evaluations(solution):
    calls = 0

    def rate(x):
        nonlocal calls
        calls += 1
        return pendulum(x)

    before = solve(rate, grid_of(TIME), solution[:1], solution)
    fresh, calls = calls, 0
    solve(rate, grid_of(TIME), solution[:1], before.states, before)
    assert calls < fresh


def test_a_branch_left_out_by_where_has_no_slope():
    """An empty tank fills: at level 0 the root's slope is infinite, but the outflow is 0."""
    time = even_times(10.0, 201)
    inflow = torch.where(time > 2.0, 0.1, 0.0)
    grid = grid_of(time)
    feed = grid.spread(inflow)

    def level(x):
        out = torch.where(x[:, 0] > 0.0, torch.sqrt(x[:, 0]), 0.0)
        return (feed - 0.05 * out).unsqueeze(-1)

    found = solve(level, grid, torch.zeros(1, 1, dtype=torch.float64), torch.zeros(201, 1, dtype=torch.float64))
    assert found.converged
    assert bool((found.states[time < 1.9] == 0.0).all())
    filled = solve_ivp(lambda _, h: 0.1 - 0.05 * np.sqrt(np.maximum(h, 0.0)), (2.0, 10.0), [0.0], rtol=1e-9)
    assert found.states[-1, 0] == pytest.approx(filled.y[0, -1], rel=0.01)


def test_the_graph_of_a_rate_with_parameters_survives_solving():
    """The user's loss can still be differentiated after solving with a parameter that requires a gradient."""
    time = even_times(2.0, 41)
    theta = torch.tensor(9.0, dtype=torch.float64, requires_grad=True)
    begin = torch.tensor([[1.0, 0.0]], dtype=torch.float64)
    squared = theta.square()

    def swing(x):
        return torch.stack([x[:, 1], -squared / 9.0 * torch.sin(x[:, 0])], -1)

    (slope,) = torch.autograd.grad(solve(swing, grid_of(time), begin, begin.expand(41, 2)).states[-1, 0], theta)

    def end(value):
        fixed = value**2 / 9.0
        return solve(
            lambda x: torch.stack([x[:, 1], -fixed * torch.sin(x[:, 0])], -1), grid_of(time), begin, begin.expand(41, 2)
        ).states[-1, 0]

    assert slope == pytest.approx(float(end(9.0 + 1e-4) - end(9.0 - 1e-4)) / 2e-4, rel=1e-5)


def test_single_precision_is_accurate():
    time = even_times(10.0, 401)
    expected = reference(pendulum, [1.0, 0.0], time.numpy())
    found = solve(pendulum, grid_of(time.float()), expected[:1].float(), perturbed(expected, 0.02).float())
    assert found.converged
    assert found.states.dtype == torch.float32
    assert float((found.states - expected).abs().max()) < 5e-4


# equations without a solution


@pytest.mark.parametrize(
    ("rate", "begin"),
    [
        (lambda x: x.square(), 1.0),
        (lambda x: x.exp(), 1.0),
        (lambda x: x * torch.nan, 1.0),
        (lambda x: -x.sqrt(), 0.1),
        (lambda x: -1.0 / x, 1.0),
    ],
    ids=["blows up", "blows up at once", "NaN", "runs dry", "singular"],
)
def test_equations_without_a_solution_fail_after_few_evaluations(rate, begin):
    calls = 0

    def counted(x):
        nonlocal calls
        calls += 1
        return rate(x)

    start = torch.full((1, 1), begin, dtype=torch.float64)
    found = solve(counted, grid_of(even_times(2.0, 101)), start, start.expand(101, 1))
    assert not found.converged
    assert calls < 1000


def test_a_single_unsolved_trajectory_fails_the_whole_grid():
    time = torch.cat([even_times(0.5, 26), even_times(2.0, 101)])
    begins = torch.zeros(127, dtype=torch.bool)
    begins[[0, 26]] = True
    begin = torch.ones(2, 1, dtype=torch.float64)
    assert not solve(torch.square, Grid(time, begins), begin, torch.ones(127, 1).double()).converged
    assert solve(torch.square, grid_of(time[:26]), begin[:1], torch.ones(26, 1).double()).converged


def test_segments_make_an_unstable_system_solvable():
    """An inverted pendulum: an error of its initial state grows by a factor of 10 million in 5 s."""

    def inverted(x):
        return torch.stack([x[:, 1], 9.0 * torch.sin(x[:, 0])], -1)

    time = even_times(5.0, 501)
    expected = reference(inverted, [1e-3, 0.0], time.numpy())
    begins = torch.arange(501) % 50 == 0
    for parts in (begins, torch.arange(501) == 0):
        found = solve(inverted, Grid(time, parts), expected[parts] + 1e-3, perturbed(expected, 0.01))
        away = float((found.states - expected).abs().max() / expected.abs().max())
        assert (found.converged and away < 0.05) == (parts is begins)
