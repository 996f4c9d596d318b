"""Linearised trajectories against the matrix exponential, and observers along them."""

import numpy as np
import pytest
import torch

from mkc_torch.simulation.dynamics.flow import flow_along, flow_of
from mkc_torch.simulation.dynamics.kalman import filtered
from mkc_torch.simulation.dynamics.noise_selection import models_of, observer_of
from mkc_torch.simulation.dynamics.observer import Disturbance
from tests.simulation.dynamics.oscillating import course, disturbed_states, flow, oscillator, recorded, theta_of

NOISE = 0.01
TINY = 1e-3


def disturbed_oscillator(count=80, runs=1, scale=1.0, **attributes):
    """Return a prepared oscillator with white process noise, its parameters, and its exact flow."""
    expected, random = flow(count, runs=runs), np.random.default_rng(0)
    position = disturbed_states(expected, course(random, expected, 0.0, 1.0))[:, 0] + NOISE * random.standard_normal(
        count * runs
    )
    prepared = oscillator(step=0.01, **attributes).prepare(recorded(expected, runs, position=scale * position))
    return prepared, theta_of(prepared), expected


def observed(prepared, theta, *disturbances):
    along = flow_of(prepared, theta, {}, None)
    observer = observer_of(along, disturbances, theta.new_tensor([NOISE]), prepared.disturbable, prepared.channels)
    return prepared.observed(observer)


def test_transitions_of_a_linear_system_are_matrix_exponentials():
    prepared, theta, expected = disturbed_oscillator(40, runs=2)
    found = flow_of(prepared, theta, {}, None)
    assert prepared.disturbable == ("speed",)
    assert len(prepared.grid.time) > 5 * 70
    np.testing.assert_allclose(found.transition, expected.transition, atol=1e-8)
    np.testing.assert_allclose(found.step, expected.step, atol=1e-12)
    np.testing.assert_array_equal(found.seen, expected.seen)
    np.testing.assert_array_equal(found.shift, 0.0)
    # noise inputs are integrated by the trapezoidal rule
    np.testing.assert_allclose(found.noise_input, expected.noise_input, atol=0.002 * abs(expected.noise_input).max())
    assert not found.transition[39].any()
    assert not found.noise_input[39].any()
    assert found.step[39] == 0.0


def test_the_flow_has_the_open_loop_residual_and_the_mask_of_outliers():
    prepared, theta, _ = disturbed_oscillator()
    prepared.counts = torch.ones_like(prepared.counts)
    prepared.counts[30] = False
    found = flow_of(prepared, theta, {}, None)
    np.testing.assert_allclose(found.new, prepared.residual(theta, {}).numpy(), atol=1e-12)
    assert np.flatnonzero(found.counts == 0.0).tolist() == [30]


def test_transitions_of_a_nonlinear_system_are_derivatives_of_its_open_loop():
    def derivative(self, time, x, u, p):
        return {"position": x.speed, "speed": -p.stiffness * torch.sin(x.position) - p.damping * x.speed}

    def output(self, time, x, u, p):
        return {"position": torch.sin(x.position) + 0.1 * x.speed**2}

    prepared, theta, _ = disturbed_oscillator(20, derivative=derivative, output=output)
    theta[2:] = torch.tensor([1.5, 0.5])
    found = flow_of(prepared, theta, {}, None)

    def last(begin):
        return prepared.trajectory(torch.cat([theta[:2], begin]), {}).states[-1]

    def sight(begin):
        return prepared.simulated(torch.cat([theta[:2], begin]), {})[-1]

    all_of_it = np.linalg.multi_dot(found.transition[::-1])
    np.testing.assert_allclose(all_of_it, torch.func.jacfwd(last)(theta[2:]).numpy(), rtol=1e-6, atol=1e-8)
    slope = torch.func.jacfwd(sight)(theta[2:]).numpy()
    np.testing.assert_allclose(found.seen[-1] @ all_of_it, slope, rtol=1e-6, atol=1e-8)


def test_a_flow_along_given_states_uses_these_states():
    prepared, theta, expected = disturbed_oscillator()
    states = prepared.guess + 0.3
    found = flow_along(prepared, theta, states)
    np.testing.assert_allclose(found.transition, expected.transition, atol=1e-8)
    np.testing.assert_allclose(found.new, (prepared.measured - states[prepared.rows, :1]).numpy())


def test_state_errors_scale_with_the_output_errors():
    prepared, theta, _ = disturbed_oscillator(300)
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


def test_no_flow_without_a_trajectory():
    def derivative(self, time, x, u, p):
        return {"position": p.stiffness * x.position**2}

    prepared, theta, _ = disturbed_oscillator(60, derivative=derivative, states=("position",))
    assert flow_of(prepared, theta, {}, None) is not None
    theta[2] = 1.0
    assert flow_of(prepared, theta, {}, None) is None


@pytest.mark.parametrize("runs", [1, 2])
def test_the_residual_of_an_observer_equals_filter_innovations_along_the_open_loop(runs):
    """On a linear system, with innovations too small to be clipped."""
    prepared, theta, _ = disturbed_oscillator(runs=runs, scale=TINY)
    white = Disturbance("speed", True, 0.0, 1.0)
    corrected = observed(prepared, theta, white)
    free = flow_of(prepared, theta, {}, None)
    models = models_of(free, (white,), theta.new_tensor([NOISE]), prepared.disturbable, prepared.channels)
    expected = filtered(free.whole, models).standard[:, 0, 0]
    found = corrected.measured - corrected.simulated(theta, {})
    np.testing.assert_allclose(found / corrected.observer.spread, expected, atol=1e-5 * abs(expected).max())
    torch.testing.assert_close(corrected.residual(theta, {}), corrected.observer.whitened(found))


@pytest.mark.parametrize(
    ("disturbance", "within"),
    [
        (Disturbance("speed", True, 0.0, 1.0), 1e-5),
        # the filter holds the disturbance for a sample, the trajectory decays it
        (Disturbance("speed", True, 2.0, 1.0), 0.02),
        (Disturbance("position", False, 2.0, 0.1), 1e-5),
    ],
)
def test_filter_innovations_do_not_depend_on_the_linearised_trajectory(disturbance, within):
    """The shifts by corrections and disturbances are compensated."""
    prepared, theta, _ = disturbed_oscillator(scale=TINY)
    corrected = observed(prepared, theta, disturbance)
    innovations = []
    for simulation in (prepared, corrected):
        along = flow_of(simulation, theta, {}, None)
        models = models_of(along, (disturbance,), theta.new_tensor([NOISE]), prepared.disturbable, prepared.channels)
        innovations.append(filtered(along.whole, models).standard[:, 0, 0])
    assert abs(along.shift).max() > 0.0 or not disturbance.at_rate
    np.testing.assert_allclose(innovations[1], innovations[0], atol=within * abs(innovations[0]).max())


def test_an_observer_for_negligible_process_noise_equals_the_open_loop():
    prepared, theta, _ = disturbed_oscillator()
    corrected = observed(prepared, theta, Disturbance("speed", True, 0.0, 1e-9), Disturbance("speed", True, 1.0, 1e-9))
    torch.testing.assert_close(corrected.residual(theta, {}), prepared.residual(theta, {}), rtol=1e-6, atol=1e-9)
    assert corrected.trajectory(theta, {}).states.shape[1] == 3


def test_runs_are_observed_independently():
    together, theta, _ = disturbed_oscillator(60, runs=2)
    white = Disturbance("speed", True, 0.0, 1.0)
    found = observed(together, theta, white).simulated(theta, {})
    for run in range(2):
        rows = slice(60 * run, 60 * run + 60)
        alone = oscillator(step=0.01).prepare(recorded(flow(60), position=together.measured[rows, 0].numpy()))
        alone.counts = together.counts[rows]
        expected = observed(alone, theta_of(alone), white).simulated(theta_of(alone), {})
        torch.testing.assert_close(found[rows], expected, rtol=1e-8, atol=1e-10)


def test_innovations_are_whiter_and_smaller_than_open_loop_residuals():
    prepared, theta, _ = disturbed_oscillator(300)
    corrected = observed(prepared, theta, Disturbance("speed", True, 0.0, 1.0))
    free, left = (simulation.residual(theta, {})[:, 0].numpy() for simulation in (prepared, corrected))
    assert abs(np.corrcoef(free[1:], free[:-1])[0, 1]) > 0.9
    assert abs(np.corrcoef(left[1:], left[:-1])[0, 1]) < 3.0 / np.sqrt(300)
    assert left.std() < 0.3 * free.std()
    assert (left / corrected.observer.spread[:, 0].numpy()).std() == pytest.approx(1.0, abs=0.15)


def test_derivatives_with_an_observer_match_finite_differences():
    prepared, theta, _ = disturbed_oscillator(40)
    disturbances = Disturbance("speed", True, 0.0, 0.3), Disturbance("position", False, 1.0, 0.02)
    corrected = observed(prepared, theta, *disturbances)
    slope = torch.func.jacfwd(lambda parameters: corrected.residual(parameters, {}))(theta)
    for k, direction in enumerate(1e-5 * torch.eye(4, dtype=torch.float64)):
        difference = corrected.residual(theta + direction, {}) - corrected.residual(theta - direction, {})
        torch.testing.assert_close(slope[..., k], difference / 2e-5, rtol=1e-5, atol=1e-7)
