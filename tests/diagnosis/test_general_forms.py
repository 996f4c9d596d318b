"""General forms are named only if their named special cases do not fit."""

import math

import numpy as np
import pytest
import torch

from mkc_torch import diagnose
from mkc_torch.simulation import Dynamics, Parameter
from tests.diagnosis.test_dynamics_diagnosis import (
    QUICK,
    Pendulum,
    only_confirmed_finding,
    pendulum_recording,
    solved_recording,
    value,
)

pytestmark = pytest.mark.e2e


class Body(Dynamics):
    """Heated, in a room whose temperature is known."""

    states = ("temp",)
    inputs = ("power", "room")
    parameters = {"capacity": Parameter(40.0, lower=1.0), "loss": Parameter(0.4, lower=0.0)}
    units = {"temp": "°C"}
    input_hold = "held"

    def derivative(self, time, x, u, p):
        return {"temp": (u.power - p.loss * (x.temp - u.room)) / p.capacity}


def heated_body_recording(rate, first, noise, seed=0):
    """400 samples of a body that is heated in steps, held between samples as its equations have it."""
    time = np.arange(400) * 2.0
    power = np.repeat(np.random.default_rng(seed).uniform(0.0, 40.0, 20), 20)
    room = 20.0 + np.sin(time / 150.0)

    def driven(t, y):
        k = min(int(t / 2.0 + 1e-9), 399)
        return rate(y, power[k], room[k])

    return solved_recording(driven, first, time, noise, seen=("temp",), power=power, room=room)


def test_convection_is_named_with_its_exponent():
    def rate(y, power, room):
        away = y[0] - room
        return [(power - 0.3 * away - 0.04 * abs(away) ** 1.4 * np.sign(away)) / 50.0]

    finding = only_confirmed_finding(diagnose(Body(), heated_body_recording(rate, [20.0], 0.05), **QUICK), "power_law")
    exponent, error = value(finding, "exponent")
    assert exponent == pytest.approx(1.4, abs=3.0 * error)
    assert error < 0.1
    assert "u = room" in finding.equation


def test_a_wall_that_takes_up_heat_is_named_and_sized():
    """The wall has two fifths of the body's capacity, and no loss to the room."""

    def rate(y, power, room):
        flow = 0.5 * (y[1] - y[0])
        return [(power - 0.4 * (y[0] - room) + flow) / 50.0, -flow / 20.0]

    finding = only_confirmed_finding(
        diagnose(Body(), heated_body_recording(rate, [20.0, 20.0], 0.05), **QUICK), "hidden_lag"
    )
    assert value(finding, "share")[0] == pytest.approx(0.4, abs=0.04)
    assert value(finding, "time_constant")[0] == pytest.approx(40.0, abs=4.0)


class Joint(Dynamics):
    """An arm on a stiff shaft, as its equations have it."""

    states = ("angle", "speed")
    inputs = ("torque",)
    parameters = {"inertia": Parameter(0.9, lower=0.1), "damping": Parameter(0.3, lower=0.0)}
    units = {"angle": "rad", "speed": "rad/s"}
    step = 0.02

    def derivative(self, time, x, u, p):
        return {"angle": x.speed, "speed": (u.torque - 6.0 * x.angle - p.damping * x.speed) / p.inertia}


def test_a_flexible_joint_is_named_with_its_period():
    """By places and forces: an arm of 0.2 of the drive's inertia behind a spring of 20 units."""
    time = np.arange(300) * 0.02
    torque = 3.0 * np.sin(2.0 * time) + 3.0 * np.sin(5.3 * time) + 3.0 * np.sin(11.0 * time + 1.0)

    def rate(t, y):
        spring = 20.0 * (y[2] - y[0]) + 0.1 * (y[3] - y[1])
        return [y[1], np.interp(t, time, torque) - 6.0 * y[0] - 0.3 * y[1] + spring, y[3], -spring / 0.2]

    recording = solved_recording(rate, [0.3, 0.0, 0.3, 0.0], time, 0.005, seen=("angle",), torque=torque)
    finding = only_confirmed_finding(diagnose(Joint(), recording, **QUICK), "hidden_mode")
    assert value(finding, "share")[0] == pytest.approx(0.2, abs=0.02)
    assert value(finding, "period")[0] == pytest.approx(2.0 * math.pi / 10.0, rel=0.02)
    assert value(finding, "damping")[0] == pytest.approx(0.1 / (2.0 * 0.2 * 10.0), abs=0.02)


class Free(Pendulum):
    """With a damping that is known."""

    parameters = {"stiffness": 8.0}

    def derivative(self, time, x, u, p):
        return {"angle": x.speed, "speed": -p.stiffness * torch.sin(x.angle) - 0.05 * x.speed}


@pytest.mark.parametrize("name", ["linear_drag", "quadratic_drag"])
def test_integer_powers_are_named_as_their_special_cases(name):
    drags = {"linear_drag": lambda _, v: -0.06 * v, "quadratic_drag": lambda _, v: -0.12 * v * abs(v)}
    only_confirmed_finding(diagnose(Free(), pendulum_recording(drags[name]), **QUICK), name)
