"""The first guess along an observer is its solution where the equations are linear, and leads to it elsewhere."""

import math

import numpy as np
import pytest
import torch

from mkc_torch.recording import Recording
from mkc_torch.simulation import Dynamics
from mkc_torch.simulation.dynamics.first_fit import with_strong_observer
from mkc_torch.simulation.dynamics.first_observed import first_observed
from mkc_torch.simulation.dynamics.noise import most_likely_noise

STEP = 0.05


class Spring(Dynamics):
    states, parameters = ("place", "speed"), {"stiffness": 4.0}
    units = {"place": "m", "speed": "m/s"}

    def derivative(self, time, x, u, p):
        return {"place": x.speed, "speed": -p.stiffness * x.place - 0.3 * x.speed}


class Pendulum(Spring):
    def derivative(self, time, x, u, p):
        return {"place": x.speed, "speed": -p.stiffness * torch.sin(x.place) - 0.3 * x.speed}


def disturbed(lasting, force, seed=0, samples=160):
    """Two runs of a pendulum or a spring that random forces move."""
    random, fine = np.random.default_rng(seed), 20
    time, places, runs = [], [], []
    for run in range(2):
        place, speed, force_now = 1.0, 0.0, 0.0
        share = math.exp(-STEP / fine / lasting) if lasting else 0.0
        for row in range(samples):
            time.append(STEP * row)
            places.append(place + 0.01 * random.normal())
            runs.append(run)
            for _ in range(fine):
                force_now = share * force_now + math.sqrt(1.0 - share**2) * random.normal() * (1.0 if lasting else 6.0)
                speed += STEP / fine * (force(place) - 0.3 * speed + force_now)
                place += STEP / fine * speed
    columns = {"time": time, "place": places, "experiment": runs}
    return Recording({name: torch.tensor(np.array(values), dtype=torch.float64) for name, values in columns.items()})


def observed(system, lasting, force):
    """The open loop, its observer, and the first guess along it."""
    prepared = system.prepare(disturbed(lasting, force))
    theta = prepared.start()
    near = prepared.trajectory(theta, {})
    found = most_likely_noise(prepared, theta, {}, near, declared={}, least=6.0, most=1, known=None)
    assert found is not None
    assert found.observer is not None
    return prepared, theta, near, found.observer, first_observed(prepared, theta, {}, near, found.observer)


def test_the_guess_for_linear_equations_is_the_solution():
    prepared = Spring().prepare(disturbed(0.0, lambda place: -4.0 * place))
    theta = prepared.start()
    strong, near = with_strong_observer(prepared, theta, 10.0), prepared.trajectory(theta, {})
    assert not strong.observer.lasting
    guess = first_observed(prepared, theta, {}, near, strong.observer)
    solution = strong.trajectory(theta, {}, guess).states
    size = solution.std(0)
    assert ((near.states - solution).abs().amax(0) > 0.5 * size).all()  # the open loop is somewhere else
    rows = prepared.rows
    assert ((guess.states - solution)[rows].abs() < 1e-6 * size).all()


@pytest.mark.parametrize(("system", "force"), [
    (Spring, lambda place: -4.0 * place),
    (Pendulum, lambda place: -4.0 * math.sin(place)),
])  # fmt: skip
def test_the_guess_is_near_the_solution_with_a_lasting_disturbance(system, force):
    prepared, theta, _, observer, guess = observed(system(), 0.6, force)
    assert [disturbance.place for disturbance in observer.lasting] == ["speed"]
    assert guess.states.shape[1] == 3
    found = prepared.observed(observer).trajectory(theta, {}, guess)
    assert found.converged
    away, size = (guess.states - found.states)[:, :2].abs().mean(0), found.states[:, :2].std(0)
    assert (away < 0.02 * size).all()


def test_there_is_no_guess_without_an_open_loop():
    class Diverging(Spring):
        def derivative(self, time, x, u, p):
            return {"place": x.speed, "speed": torch.exp(40.0 * x.place.abs())}

    prepared, theta, _, observer, _ = observed(Spring(), 0.0, lambda place: -4.0 * place)
    other = Diverging().prepare(prepared.whole)
    assert first_observed(other, theta, {}, None, observer) is None
