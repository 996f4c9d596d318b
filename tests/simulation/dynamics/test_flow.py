"""Linearised trajectories, against the matrix exponential, and what an observer makes of them."""

import numpy as np
import pytest
import torch

from mkc_torch.simulation.dynamics.flow import flow_along, flow_of
from mkc_torch.simulation.dynamics.kalman import filtered
from mkc_torch.simulation.dynamics.noise_selection import models_of, observer_of
from mkc_torch.simulation.dynamics.observer import Disturbance
from tests.simulation.dynamics.oscillating import course, flow, oscillator, pushed, recorded, theta_of

NOISE = 0.01
TINY = 1e-3


def world(count=80, runs=1, scale=1.0, **attributes):
    """A prepared oscillator under white pushes, its parameters, and the flow that it should have."""
    expected, random = flow(count, runs=runs), np.random.default_rng(0)
    position = pushed(expected, course(random, expected, 0.0, 1.0))[:, 0] + NOISE * random.standard_normal(count * runs)
    prepared = oscillator(step=0.01, **attributes).prepare(recorded(expected, runs, position=scale * position))
    return prepared, theta_of(prepared), expected


def observed(prepared, theta, *disturbances):
    along = flow_of(prepared, theta, {}, None)
    observer = observer_of(along, disturbances, theta.new_tensor([NOISE]), prepared.pushable, prepared.channels)
    return prepared.observed(observer)


def test_a_linear_system_s_flow_is_its_matrix_exponential():
    prepared, theta, expected = world(40, runs=2)
    found = flow_of(prepared, theta, {}, None)
    assert prepared.pushable == ("speed",)
    assert len(prepared.grid.time) > 5 * 70
    np.testing.assert_allclose(found.carried, expected.carried, atol=1e-8)
    np.testing.assert_allclose(found.step, expected.step, atol=1e-12)
    np.testing.assert_array_equal(found.seen, expected.seen)
    np.testing.assert_array_equal(found.shift, 0.0)
    # pushes are added up by trapezia
    np.testing.assert_allclose(found.pushed, expected.pushed, atol=0.002 * abs(expected.pushed).max())
    assert not found.carried[39].any()
    assert not found.pushed[39].any()
    assert found.step[39] == 0.0


def test_what_is_new_is_the_free_run_s_residual_and_outliers_do_not_count():
    prepared, theta, _ = world()
    prepared.counts = torch.ones_like(prepared.counts)
    prepared.counts[30] = False
    found = flow_of(prepared, theta, {}, None)
    np.testing.assert_allclose(found.new, prepared.residual(theta, {}).numpy(), atol=1e-12)
    assert np.flatnonzero(found.counts == 0.0).tolist() == [30]


def test_a_curved_system_s_flow_is_the_slope_of_its_free_run():
    def derivative(self, time, x, u, p):  # noqa: ARG001
        return {"position": x.speed, "speed": -p.stiffness * torch.sin(x.position) - p.damping * x.speed}

    def output(self, time, x, u, p):  # noqa: ARG001
        return {"position": torch.sin(x.position) + 0.1 * x.speed**2}

    prepared, theta, _ = world(20, derivative=derivative, output=output)
    theta[2:] = torch.tensor([1.5, 0.5])
    found = flow_of(prepared, theta, {}, None)

    def last(begin):
        return prepared.trajectory(torch.cat([theta[:2], begin]), {}).states[-1]

    def sight(begin):
        return prepared.simulated(torch.cat([theta[:2], begin]), {})[-1]

    all_of_it = np.linalg.multi_dot(found.carried[::-1])
    np.testing.assert_allclose(all_of_it, torch.func.jacfwd(last)(theta[2:]).numpy(), rtol=1e-6, atol=1e-8)
    slope = torch.func.jacfwd(sight)(theta[2:]).numpy()
    np.testing.assert_allclose(found.seen[-1] @ all_of_it, slope, rtol=1e-6, atol=1e-8)


def test_it_is_of_states_as_they_are_given_too():
    prepared, theta, expected = world()
    states = prepared.guess + 0.3
    found = flow_along(prepared, theta, states)
    np.testing.assert_allclose(found.carried, expected.carried, atol=1e-8)
    np.testing.assert_allclose(found.new, (prepared.measured - states[prepared.rows, :1]).numpy())


def test_states_may_be_off_by_as_much_as_the_outputs_are():
    prepared, theta, _ = world(300)
    resting = flow_of(prepared, theta, {}, None)
    np.testing.assert_allclose(resting.spread, prepared.guess[prepared.rows].std(0).numpy())
    near = flow_along(prepared, theta, prepared.guess)
    np.testing.assert_allclose(near.spread, 0.1 * resting.spread)
    half = flow_along(prepared, theta, 0.5 * prepared.guess)
    np.testing.assert_allclose(half.spread, 0.5 * resting.spread, rtol=0.02)
    prepared.measured[::2] += 100.0
    prepared.counts = torch.ones_like(prepared.counts)
    prepared.counts[::2] = False
    others = flow_along(prepared, theta, 0.5 * prepared.guess)
    np.testing.assert_allclose(others.spread, half.spread, rtol=0.1)


def test_there_is_none_where_there_is_no_trajectory():
    def derivative(self, time, x, u, p):  # noqa: ARG001
        return {"position": p.stiffness * x.position**2}

    prepared, theta, _ = world(60, derivative=derivative, states=("position",))
    assert flow_of(prepared, theta, {}, None) is not None
    theta[2] = 1.0
    assert flow_of(prepared, theta, {}, None) is None


@pytest.mark.parametrize("runs", [1, 2])
def test_an_observed_run_s_residual_is_what_is_new_to_a_filter_along_the_free_one(runs):
    """On a linear system, where innovations are so small that none is held for an outlier."""
    prepared, theta, _ = world(runs=runs, scale=TINY)
    white = Disturbance("speed", True, 0.0, 1.0)
    watched = observed(prepared, theta, white)
    free = flow_of(prepared, theta, {}, None)
    models = models_of(free, (white,), theta.new_tensor([NOISE]), prepared.pushable, prepared.channels)
    expected = filtered(free.whole, models).standard[:, 0, 0]
    found = watched.measured - watched.simulated(theta, {})
    np.testing.assert_allclose(found / watched.observer.spread, expected, atol=1e-5 * abs(expected).max())
    torch.testing.assert_close(watched.residual(theta, {}), watched.observer.whitened(found))


@pytest.mark.parametrize(
    ("disturbance", "within"),
    [
        (Disturbance("speed", True, 0.0, 1.0), 1e-5),
        (Disturbance("speed", True, 2.0, 1.0), 0.02),  # that holds a push for a sample, and there it fades
        (Disturbance("position", False, 2.0, 0.1), 1e-5),
    ],
)
def test_along_an_observed_run_a_filter_finds_the_same_as_along_the_free_one(disturbance, within):
    """What corrections and pushes moved by themselves is taken off."""
    prepared, theta, _ = world(scale=TINY)
    watched = observed(prepared, theta, disturbance)
    innovations = []
    for one in (prepared, watched):
        along = flow_of(one, theta, {}, None)
        models = models_of(along, (disturbance,), theta.new_tensor([NOISE]), prepared.pushable, prepared.channels)
        innovations.append(filtered(along.whole, models).standard[:, 0, 0])
    assert abs(along.shift).max() > 0.0 or not disturbance.at_rate
    np.testing.assert_allclose(innovations[1], innovations[0], atol=within * abs(innovations[0]).max())


def test_an_observer_for_no_push_to_speak_of_is_the_free_run():
    prepared, theta, _ = world()
    watched = observed(prepared, theta, Disturbance("speed", True, 0.0, 1e-9), Disturbance("speed", True, 1.0, 1e-9))
    torch.testing.assert_close(watched.residual(theta, {}), prepared.residual(theta, {}), rtol=1e-6, atol=1e-9)
    assert watched.trajectory(theta, {}).states.shape[1] == 3


def test_runs_are_observed_each_by_itself():
    together, theta, _ = world(60, runs=2)
    white = Disturbance("speed", True, 0.0, 1.0)
    found = observed(together, theta, white).simulated(theta, {})
    for run in range(2):
        rows = slice(60 * run, 60 * run + 60)
        alone = oscillator(step=0.01).prepare(recorded(flow(60), position=together.measured[rows, 0].numpy()))
        alone.counts = together.counts[rows]
        expected = observed(alone, theta_of(alone), white).simulated(theta_of(alone), {})
        torch.testing.assert_close(found[rows], expected, rtol=1e-8, atol=1e-10)


def test_what_an_observer_leaves_is_whiter_and_smaller_than_what_a_free_run_does():
    prepared, theta, _ = world(300)
    watched = observed(prepared, theta, Disturbance("speed", True, 0.0, 1.0))
    free, left = (one.residual(theta, {})[:, 0].numpy() for one in (prepared, watched))
    assert abs(np.corrcoef(free[1:], free[:-1])[0, 1]) > 0.9
    assert abs(np.corrcoef(left[1:], left[:-1])[0, 1]) < 3.0 / np.sqrt(300)
    assert left.std() < 0.3 * free.std()
    assert (left / watched.observer.spread[:, 0].numpy()).std() == pytest.approx(1.0, abs=0.15)


def test_a_derivative_of_an_observed_run_is_finite_differences():
    prepared, theta, _ = world(40)
    watched = observed(prepared, theta, Disturbance("speed", True, 0.0, 0.3), Disturbance("position", False, 1.0, 0.02))
    slope = torch.func.jacfwd(lambda one: watched.residual(one, {}))(theta)
    for k, direction in enumerate(1e-5 * torch.eye(4, dtype=torch.float64)):
        difference = watched.residual(theta + direction, {}) - watched.residual(theta - direction, {})
        torch.testing.assert_close(slope[..., k], difference / 2e-5, rtol=1e-5, atol=1e-7)
