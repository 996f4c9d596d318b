"""First fits over short horizons from poor guesses of the parameters."""

import copy

import numpy as np
import pytest
import torch

from mkc_torch.simulation import Dynamics, Parameter
from mkc_torch.simulation.dynamics.first_fit import floor_of, multiple_shooting_start, strong_observer
from tests.simulation.dynamics.oscillating import flow, oscillator, recorded, theta_of
from tests.simulation.dynamics.runge_kutta import runge_kutta

STIFFNESS, DAMPING, FIRST, NOISE = 9.0, 0.15, (1.8, 0.4), 0.01
FLOW = flow(400)


class Pendulum(Dynamics):
    states = ("angle", "speed")
    parameters = {"stiffness": Parameter(1.0, lower=0.0), "damping": Parameter(1.0, lower=0.0)}

    def derivative(self, time, x, u, p):
        return {"angle": x.speed, "speed": -p.stiffness * torch.sin(x.angle) - p.damping * x.speed}


def rate(_, y):
    return np.array([y[1], -STIFFNESS * np.sin(y[0]) - DAMPING * y[1]])


@pytest.fixture(scope="module")
def pendulum():
    """Return a prepared pendulum that swings for 20 s."""
    angle = runge_kutta(rate, FIRST, 0.05 * np.arange(400), parts=5)[:, 0]
    return Pendulum().prepare(recorded(FLOW, angle=angle + NOISE * np.random.default_rng(0).standard_normal(400)))


@pytest.mark.e2e
@pytest.mark.parametrize(("stiffness", "damping"), [(90.0, 1.5), (90.0, 0.015), (0.9, 1.5)])
def test_parameters_off_by_a_factor_of_ten_are_recovered(pendulum, stiffness, damping):
    guess = torch.cat([torch.tensor([stiffness, damping], dtype=torch.float64), pendulum.given[2:]])
    found = multiple_shooting_start(pendulum, guess)
    assert float(found[0]) == pytest.approx(STIFFNESS, rel=0.05)
    assert float(found[1]) == pytest.approx(DAMPING, abs=0.1)
    assert found[2:].tolist() == pytest.approx(FIRST, abs=0.15)
    # the open loop stays in phase to the end
    assert float(pendulum.residual(found, {}).abs().max()) < 0.5
    # NaN counts too: rounding decides whether it diverges
    assert not float(pendulum.residual(guess, {}).abs().max()) <= 1.5


def test_bounds_are_kept(pendulum):
    low, high = pendulum.bounds
    bounds = low.clone(), high.clone()
    bounds[0][1], bounds[1][0] = 0.3, 8.0
    held = copy.copy(pendulum)
    held.bounds = bounds
    found = multiple_shooting_start(held, torch.cat([torch.tensor([2.0, 1.0]).double(), pendulum.given[2:]]))
    assert float(found[0]) <= 8.0
    assert float(found[1]) >= 0.3


def test_no_fit_where_no_rate_moves_an_output():
    def output(self, time, x, u, p):
        return {"position": 0.0 * x.position + p.stiffness}

    prepared = oscillator(output=output).prepare(recorded(flow(30), position=np.sin(np.arange(30.0))))
    assert multiple_shooting_start(prepared, theta_of(prepared)) is None
    assert strong_observer(prepared, theta_of(prepared), 10.0) is None


def test_no_fit_where_the_equations_are_not_finite(pendulum):
    nowhere = torch.tensor([np.nan, 1.0, *FIRST], dtype=torch.float64)
    assert strong_observer(pendulum, nowhere, 10.0) is None
    assert multiple_shooting_start(pendulum, nowhere) is None


def test_a_stronger_observer_has_smaller_prediction_errors(pendulum):
    guess = torch.tensor([30.0, 1.0, *FIRST], dtype=torch.float64)
    left = []
    for size in (1.0, 10.0, 100.0):
        observer = strong_observer(pendulum, guess, size)
        assert [
            (disturbance.place, disturbance.at_rate, disturbance.lasting) for disturbance in observer.disturbances
        ] == [("speed", True, 0.0)]
        predicted = pendulum.observed(observer).simulated(guess, {})
        left.append(float((pendulum.measured - predicted).std()))
    assert left[0] > 2.0 * left[1] > 10.0 * left[2]
    sizes = [strong_observer(pendulum, guess, size).disturbances[0].size for size in (1.0, 7.0)]
    assert sizes[1] == pytest.approx(7.0 * sizes[0])


class TestFloor:
    """The noise floor by third differences."""

    @pytest.mark.parametrize("runs", [1, 4])
    def test_the_noise_of_a_smooth_signal_is_recovered(self, runs):
        time = np.tile(0.05 * np.arange(400 // runs), runs)
        # the level jumps between runs
        smooth = np.sin(time) + 100.0 * np.repeat(np.arange(runs), 400 // runs)
        noise = np.random.default_rng(1).standard_normal(400)
        prepared = oscillator(step=0.05).prepare(
            recorded(flow(400 // runs, runs=runs), runs, position=smooth + 0.02 * noise)
        )
        assert floor_of(prepared).tolist() == pytest.approx([0.02], rel=0.15)

    def test_the_floor_is_positive_without_noise(self):
        prepared = oscillator(step=0.05).prepare(recorded(flow(40), position=np.arange(40.0)))
        assert floor_of(prepared).item() == pytest.approx(1e-6 * np.arange(40.0).std(ddof=1))
