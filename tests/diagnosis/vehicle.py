"""Simulated recordings of a vehicle and of a pendulum whose missing physics can differ from recording to recording."""

import torch

from mkc_torch import Recording
from mkc_torch.simulation import Dynamics, Parameter

MASS = 1200.0
ROLLING = 0.15


class Vehicle(Dynamics):
    """A vehicle on a level road, with rolling resistance and without air drag; its mass was weighed."""

    states, inputs = ("speed",), ("force",)
    parameters = {"rolling": 0.1, "mass": Parameter(MASS, lower=MASS - 0.01, upper=MASS + 0.01)}
    units = {"speed": "m/s", "force": "N"}

    def derivative(self, time, x, u, p):
        return {"speed": u.force / p.mass - p.rolling}


class DraggedVehicle(Vehicle):
    """The same with a common air drag."""

    parameters = {**Vehicle.parameters, "drag": Parameter(0.01, lower=0.0)}

    def derivative(self, time, x, u, p):
        return {"speed": u.force / p.mass - p.rolling - p.drag * x.speed * x.speed.abs()}


class Pendulum(Dynamics):
    """A damped pendulum on a motor, without dry friction."""

    states, inputs, outputs = ("angle", "rate"), ("torque",), ("angle",)
    parameters = {"damping": 0.1, "stiffness": 9.0}
    units = {"angle": "rad", "rate": "rad/s"}

    def derivative(self, time, x, u, p):
        return {"angle": x.rate, "rate": u.torque - p.damping * x.rate - p.stiffness * torch.sin(x.angle)}


def _solved(rate, start, inputs, step, parts=20):
    """Solve differential equations by the classical Runge-Kutta method; inputs are held."""
    state, states, h = torch.tensor(start, dtype=torch.float64), [], step / parts
    for value in inputs.tolist():
        states.append(state)
        for _ in range(parts):
            first = rate(state, value)
            second = rate(state + h / 2 * first, value)
            third = rate(state + h / 2 * second, value)
            state = state + h / 6 * (first + 2 * second + 2 * third + rate(state + h * third, value))
    return torch.stack(states)


def _levels(count, generator, size, least, most):
    """Return an input that is constant for ``least`` to ``most`` samples."""
    values, number = torch.zeros(count, dtype=torch.float64), 0
    while number < count:
        length = int(torch.randint(least, most, (1,), generator=generator))
        values[number : number + length] = size * torch.rand(1, generator=generator, dtype=torch.float64)
        number += length
    return values


def coast_down(drag, speed, seed, name, count=400):
    """Return a recording of a vehicle with quadratic drag in 1/m, at 10 Hz, with 0.05 m/s of white noise."""
    g = torch.Generator().manual_seed(seed)
    force = _levels(count, g, 9000.0, 30, 70) * (_levels(count, g, 1.0, 30, 70) > 0.4)

    def rate(state, force):
        return force / MASS - ROLLING - drag * state * state.abs()

    speeds = _solved(rate, [speed], force, 0.1)[:, 0]
    noise = 0.05 * torch.randn(count, generator=g, dtype=torch.float64)
    time = torch.arange(count, dtype=torch.float64) / 10.0
    return Recording({"time": time, "speed": speeds + noise, "force": force}, name=name)


def swing(friction, seed, name, count=600):
    """Return a recording of a pendulum with dry friction in rad/s², at 20 Hz, with 2 mrad of white noise."""
    g = torch.Generator().manual_seed(seed)
    torque = _levels(count, g, 8.0, 10, 40) - 4.0

    def rate(state, torque):
        angle, speed = state
        dry = friction * torch.tanh(speed / 0.005)
        return torch.stack([speed, torque - 0.15 * speed - 10.0 * torch.sin(angle) - dry])

    angles = _solved(rate, [0.3, 0.0], torque, 0.05)[:, 0]
    noise = 0.002 * torch.randn(count, generator=g, dtype=torch.float64)
    time = torch.arange(count, dtype=torch.float64) / 20.0
    return Recording({"time": time, "angle": angles + noise, "torque": torque}, name=name)
