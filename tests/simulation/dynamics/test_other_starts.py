"""Further starts for a first fit: other scales of its numbers, and other values after a failure."""

import numpy as np
import pytest
import torch

from mkc_torch import Recording
from mkc_torch.diagnosis.model.process_noise import fit_alone
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.simulation import Dynamics, Parameter
from mkc_torch.simulation.dynamics.other_starts import at_other_scales, log_size_at, other_starts
from mkc_torch.simulation.names import Names
from tests.simulation.stepped.test_servo import INERTIA, STIFFNESS, Servo, followed


class Growing(Dynamics):
    states = ("speed",)
    outputs = ("rpm",)
    parameters = {"a": 80.0, "b": 1.0}

    def derivative(self, time, x, u, p):
        return {"speed": p.a * x.speed + p.b}

    def output(self, time, x, u, p):
        return {"rpm": 9.5 * x.speed}


def prepared(**parameters):
    time = torch.arange(120, dtype=torch.float64) / 10.0
    simulation = Growing()
    simulation.parameters = {**Growing.parameters, **parameters}
    return simulation.prepare(Recording({"time": time, "rpm": 1.0 - torch.exp(-time)}))


def test_starts_are_finite_and_sorted_and_the_wrong_parameter_is_named():
    free = prepared()
    found = other_starts(free, free.given, 3)
    assert len(found.starts) == 3
    left = [free.residual(start, {}) for start in found.starts]
    assert all(bool(residual.isfinite().all()) for residual in left)
    sizes = [float(residual.abs().median()) for residual in left]
    assert sizes == sorted(sizes)
    assert (found.output, found.parameter) == ("rpm", "a")
    assert 0.0 <= found.until < 12.0
    assert found.lasts == torch.inf


def test_starts_stay_within_the_bounds():
    free = prepared(a=Parameter(80.0, lower=79.0))
    found = other_starts(free, free.given, 3)
    assert found.output == "rpm"
    assert all(float(start[0]) >= 79.0 for start in found.starts)


def test_positive_numbers_with_an_uncertainty_are_tried_at_other_scales():
    system = Servo().prepare(followed())
    tried = [theta[0].item() for theta in at_other_scales(system, system.given)]
    assert tried == pytest.approx([STIFFNESS / 32.0, STIFFNESS / 8.0, 8.0 * STIFFNESS])
    assert all(torch.equal(theta[1:], system.given[1:]) for theta in at_other_scales(system, system.given))
    without = prepared(a=Parameter(80.0, lower=0.0))
    assert at_other_scales(without, without.given) == []
    soft = Servo().prepare(followed(stiffness=STIFFNESS / 30.0))
    sizes = [log_size_at(soft, theta) for theta in (soft.given, *at_other_scales(soft, soft.given))]
    assert min(sizes) == sizes[1]


class Limited(Servo):
    """A servo whose moment is limited, so that one that is far too stiff holds its largest moment all the time."""

    largest = 0.3

    def step(self, x, u, tau, p, dt):
        angle, speed = x.T
        moment = (p.stiffness * (u[:, 0] - angle)).clip(-self.largest, self.largest) + tau[:, 0] - 0.1 * speed
        speed = speed + dt * moment / INERTIA
        return np.stack([angle + dt * speed, speed], 1)


@pytest.mark.parametrize(("largest", "given"), [(0.3, 1200.0), (0.4, 2000.0), (0.6, 2800.0)])
def test_a_servo_that_is_given_far_too_stiff_is_fitted_all_the_same(largest, given):
    true, simulation = 3.0, Limited()
    simulation.largest = largest
    simulation.parameters = {"stiffness": Parameter(given, lower=0.0, unit="N m/rad", uncertainty=0.69 * given)}
    time = 0.02 * torch.arange(300, dtype=torch.float64)
    command = 0.15 * torch.sin(2.0 * torch.pi * (0.2 + 0.12 * time) * time)
    state, angles = np.zeros((1, 2)), []
    for held in command.tolist():
        angles.append(state[0, 0])
        for _ in range(2):
            u, tau = np.array([[held]]), np.zeros((1, 1))
            state = simulation.step(state, u, tau, Names(stiffness=true), simulation.time_step)
    angle = torch.tensor(np.array(angles) + 1e-4 * np.random.default_rng(0).normal(size=300))
    recording = Recording({"time": time, "command": command, "angle": angle})
    found = fit_alone(simulation.prepare(recording), {}, Settings().noise)
    assert found.free is not None
    assert float(found.free.parameters[0]) == pytest.approx(true, rel=0.05)
