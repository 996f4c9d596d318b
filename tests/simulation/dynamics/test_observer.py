"""Trajectories whose states jump at the samples, against Runge & Kutta's method with the same corrections."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mkc_torch.simulation.dynamics.observer import Disturbance, Observer, ObserverJump
from mkc_torch.simulation.dynamics.trajectory import Grid, marched, solve, stations, transition_matrices
from tests.simulation.dynamics.runge_kutta import runge_kutta

INTERVALS_PER_SAMPLE = 4
"""Grid intervals between samples."""


def tensor(values):
    return torch.as_tensor(np.array(values), dtype=torch.float64)


def pendulum(x):
    return torch.stack([x[:, 1], -9.0 * torch.sin(x[:, 0]) - 0.2 * x[:, 1]], -1)


def random_correction(samples, m=1, seed=0, spread=0.05, places=(0, 1)):
    """Random gains and a random recording for a pendulum with the sine of its angle, and its speed, as outputs."""
    random = np.random.default_rng(seed)
    observer = Observer(
        ("sine", "speed")[:m],
        (),
        tensor([0.01] * m),
        tensor(0.3 * random.standard_normal((samples, len(places), m))),
        tensor(np.broadcast_to(np.eye(m), (samples, m, m))),
        tensor(spread * random.uniform(0.5, 2.0, (samples, m))),
    )

    def predict(states):
        return torch.stack([torch.sin(states[:, places[0]]), states[:, places[1]]], -1)[:, :m]

    measured = tensor(0.5 * random.standard_normal((samples, m)))
    return ObserverJump(observer, INTERVALS_PER_SAMPLE * torch.arange(samples), places, measured, predict)


def grid_of(samples, end=2.0):
    """Return the grid of a single trajectory with this number of samples."""
    time = torch.linspace(0.0, end, INTERVALS_PER_SAMPLE * (samples - 1) + 1, dtype=torch.float64)
    return Grid(time, torch.arange(len(time)) == 0)


def stepwise_states(rate, jump, begin, grid):
    """States just before each grid time, integrated and corrected sample by sample."""
    gain, spread = jump.observer.gain.numpy(), jump.observer.spread.numpy()
    state, time, found = np.asarray(begin, dtype=float), grid.time.numpy(), []
    samples = dict(zip(jump.rows.tolist(), range(len(jump.rows)), strict=True))
    for moment in range(len(time)):
        found.append(state)
        if moment in samples:
            k = samples[moment]
            limit = 4.0 * spread[k]
            new = jump.measured[k].numpy() - jump.predict(tensor(state[None]))[0].numpy()
            state = state.copy()
            state[list(jump.places)] += gain[k] @ (limit * np.tanh(new / limit))
        if moment + 1 < len(time):
            state = runge_kutta(rate, state, time[moment : moment + 2], parts=10)[-1]
    return np.stack(found)


def numpy_pendulum(_, y):
    return np.array([y[1], -9.0 * np.sin(y[0]) - 0.2 * y[1]])


@pytest.mark.parametrize("m", [1, 2])
def test_a_trajectory_with_jumps_matches_stepwise_integration_with_corrections(m):
    grid, jump, begin = grid_of(41), random_correction(41, m), [0.8, -0.3]
    expected = stepwise_states(numpy_pendulum, jump, begin, grid)
    found = solve(pendulum, grid, tensor([begin]), tensor(expected) + 0.05, jump=jump)
    assert found.converged
    np.testing.assert_allclose(found.states.numpy(), expected, atol=2e-5)
    free = solve(pendulum, grid, tensor([begin]), tensor(expected)).states
    assert abs(free.numpy() - expected).max() > 0.1


def test_intervals_start_from_the_corrected_states():
    grid, jump = grid_of(11), random_correction(11)
    states = solve(pendulum, grid, tensor([[0.8, -0.3]]), torch.zeros(len(grid.time), 2).double(), jump=jump).states
    torch.testing.assert_close(stations(pendulum, states, grid, jump)[::3], jump.applied(states)[:-1])
    torch.testing.assert_close(stations(pendulum, states, grid)[::3], states[:-1])


def test_a_growing_horizon_converges_from_a_far_guess():
    grid, jump, begin = grid_of(41), random_correction(41), [0.8, -0.3]
    far = torch.full((len(grid.time), 2), 30.0).double()
    rough = marched(pendulum, grid, tensor([begin]), far, jump=jump)
    np.testing.assert_allclose(rough.numpy(), stepwise_states(numpy_pendulum, jump, begin, grid), atol=1e-2)


def test_trajectories_with_jumps_are_independent():
    both = [random_correction(11, seed=seed) for seed in range(2)]
    grid = grid_of(11)
    alone = [
        solve(pendulum, grid, tensor([[0.5, 0.2]]), torch.zeros(41, 2).double(), jump=jump).states for jump in both
    ]
    observer = Observer(
        ("sine",),
        (),
        both[0].observer.sensor,
        *(
            torch.cat([getattr(correction.observer, name) for correction in both])
            for name in ("gain", "white", "spread")
        ),
    )
    jump = ObserverJump(
        observer,
        torch.cat([both[0].rows, 41 + both[1].rows]),
        (0, 1),
        torch.cat([correction.measured for correction in both]),
        both[0].predict,
    )
    together = Grid(torch.cat([grid.time, grid.time]), torch.cat([grid.begins, grid.begins]))
    found = solve(pendulum, together, tensor([[0.5, 0.2]] * 2), torch.zeros(82, 2).double(), jump=jump)
    torch.testing.assert_close(found.states, torch.cat(alone), rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_derivatives_with_jumps_match_finite_differences(mode):
    """By parameters of the rate, the initial states, the prediction and the recording."""
    grid, plain = grid_of(21), random_correction(21, 2)

    def states(theta):
        def predict(x):
            return theta[1] * plain.predict(x)

        jump = ObserverJump(plain.observer, plain.rows, plain.places, plain.measured * theta[2], predict)
        begin = torch.stack([theta[3], 0.0 * theta[3]]).unsqueeze(0)
        guess = torch.zeros(len(grid.time), 2, dtype=torch.float64)
        return solve(lambda x: theta[0] * pendulum(x), grid, begin, guess, jump=jump).states[::8]

    theta = tensor([1.0, 0.9, 1.1, 0.7])
    jacobian = torch.func.jacfwd if mode == "forward" else torch.func.jacrev
    slope = jacobian(states)(theta)
    for k, direction in enumerate(1e-5 * torch.eye(4, dtype=torch.float64)):
        difference = (states(theta + direction) - states(theta - direction)) / 2e-5
        torch.testing.assert_close(slope[..., k], difference, rtol=1e-5, atol=1e-6)


@given(seed=st.integers(0, 1000), m=st.integers(1, 2), spread=st.floats(0.01, 10.0), more=st.integers(0, 2))
@settings(max_examples=25, deadline=None, derandomize=True)
def test_the_slope_of_a_jump_matches_finite_differences(seed, m, spread, more):
    """States without gains, and grid times without samples, are unchanged."""
    jump = random_correction(4, m, seed, spread, places=(more, 1 + more))
    n = 3 + more
    states = tensor(np.random.default_rng(seed).standard_normal((INTERVALS_PER_SAMPLE * 3 + 1, n)))
    slope = jump.slope(states)
    for k, direction in enumerate(1e-6 * torch.eye(n, dtype=torch.float64)):
        difference = (jump.applied(states + direction) - jump.applied(states - direction)) / 2e-6
        torch.testing.assert_close(slope[..., k], difference, rtol=1e-5, atol=1e-7)
    elsewhere = torch.arange(len(states)) % INTERVALS_PER_SAMPLE > 0
    assert torch.equal(jump.applied(states)[elsewhere], states[elsewhere])
    assert torch.equal(slope[elsewhere], torch.eye(n).double().expand(int(elsewhere.sum()), n, n))
    assert torch.equal(jump.applied(states)[:, 2 + more :], states[:, 2 + more :])


def test_transitions_start_from_the_states_after_the_jump():
    grid, jump = grid_of(6), random_correction(6)
    states = solve(pendulum, grid, tensor([[0.8, 0.0]]), torch.zeros(21, 2).double(), jump=jump).states
    A, _ = transition_matrices(pendulum, states, grid, jump)
    expected = []
    for moment in range(20):
        after = jump.applied(states)[moment]
        moved = [
            runge_kutta(numpy_pendulum, (after + d).numpy(), grid.time[moment : moment + 2].numpy(), parts=10)[-1]
            for d in (*1e-5 * torch.eye(2).double(), *-1e-5 * torch.eye(2).double())
        ]
        expected.append(np.stack([(moved[k] - moved[k + 2]) / 2e-5 for k in range(2)], -1))
    np.testing.assert_allclose(A.numpy(), np.stack(expected), atol=1e-4)


class TestObserver:
    """Methods of observers and disturbances."""

    def test_lasting_disturbances_have_a_time_constant(self):
        disturbances = tuple(Disturbance("speed", True, lasting, 1.0) for lasting in (0.0, 2.0, 0.0, 3.0))
        empty = torch.zeros(0)
        observer = Observer((), disturbances, empty, empty, empty, empty)
        assert [disturbance.lasting for disturbance in observer.lasting] == [2.0, 3.0]

    def test_a_least_time_constant_is_applied(self):
        short, long = Disturbance("speed", True, 0.0, 1.0), Disturbance("speed", True, 5.0, 1.0)
        assert short.lasting_at_least(0.1) == Disturbance("speed", True, 0.1, 1.0)
        assert long.lasting_at_least(0.1) == long

    def test_innovations_are_whitened_sample_by_sample(self):
        random = np.random.default_rng(0)
        white, new = random.standard_normal((5, 2, 2)), random.standard_normal((5, 2))
        found = Observer.whitened(SimpleNamespace(white=tensor(white)), tensor(new))
        np.testing.assert_allclose(found.numpy(), np.stack([w @ v for w, v in zip(white, new, strict=True)]))
