"""A pendulum as a stepper and as differential equations: the same missing friction, of the same size."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from mkc_torch.diagnosis import diagnose
from mkc_torch.recording import Recording
from tests.simulation.stepped.models import Equations, Steps

FRICTION = 0.25


def swinging(samples=300, seed=3):
    """A pendulum with dry friction at its torque, integrated by SciPy."""
    rng = np.random.default_rng(seed)
    torque = np.repeat(1.5 * rng.normal(size=samples // 25), 25)
    state, angles = np.array([0.1, 0.0]), []
    for u in torque:
        angles.append(state[0])

        def rate(_, y, u=u):
            moment = u - 4.2 * math.sin(y[0]) - 0.12 * y[1] - FRICTION * math.tanh(y[1] / 0.01)
            return [y[1], moment / 0.5]

        state = solve_ivp(rate, (0.0, 0.02), state, rtol=1e-7, atol=1e-9).y[:, -1]
    angle = torch.tensor(np.array(angles) + 0.003 * rng.normal(size=samples))
    time = 0.02 * torch.arange(samples, dtype=torch.float64)
    return Recording({"time": time, "torque": torch.tensor(torque), "angle": angle})


class FineSteps(Steps):
    time_step = 0.0025  # the friction is held over a step


@pytest.mark.slow
def test_a_stepper_and_its_differential_equation_have_the_same_finding():
    recording = swinging()
    first, other = (diagnose(kind(), recording, quick=True) for kind in (Equations, FineSteps))
    assert [finding.effect for finding in first.findings] == [finding.effect for finding in other.findings]
    assert first.findings[0].effect == "coulomb_friction"
    assert first.findings[0].channels == ("rate of speed",)
    assert other.findings[0].channels == ("input moment",)
    rate, moment = (float(found.model.gammas[0][0]) for found in (first, other))
    inertia = float(first.model.theta[0])
    error = other.findings[0].parameters[0].standard_error
    assert abs(rate * inertia - moment) < 0.1 * error
    assert abs(moment - FRICTION) < 3.0 * error
