"""Effects with internal states at the force on a joint: a wheel on a flexible shaft, a spring that yields, a damper."""

import numpy as np
import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.effects import DYNAMICS, Context
from mkc_torch.simulation import Parameter, Stepper

INERTIA, DAMPING = 0.02, 0.3
WHEEL, PERIOD, RATIO = 0.015, 0.27, 0.05
STIFFNESS, YIELD = 4.0, 0.15

FAMILY = [effect for effect in DYNAMICS if effect.id in ("hidden_mode", "hidden_lag", "bouc_wen_hysteresis")]
FORCE = {effect.port: effect for effect in FAMILY}


class Rotor(Stepper):
    """A rotor that a motor turns, by semi-implicit Euler steps."""

    states, inputs, time_step = ("angle", "speed"), ("torque",), 0.005
    positions, forces = {"angle": "speed"}, {"moment": "speed"}
    units = {"angle": "rad", "speed": "rad/s", "torque": "N m", "moment": "N m"}
    parameters = {"damping": Parameter(DAMPING, lower=0.0, unit="N m s/rad")}

    def step(self, x, u, tau, p, dt):
        angle, speed = x.T
        speed = speed + dt * (u[:, 0] + tau[:, 0] - p.damping * speed) / INERTIA
        return np.stack([angle + dt * speed, speed], 1)


def shaft(s, w, v):
    """The moment of a wheel on a flexible shaft, and the wheel's acceleration."""
    omega = 2.0 * np.pi / PERIOD
    acceleration = -(omega**2) * s - 2.0 * RATIO * omega * (w - v)
    return -WHEEL * acceleration, acceleration


def recorded(kind, samples=400, noise=0.0, seed=0):
    """A recording of the rotor with an element that the simulation lacks."""
    random, h = np.random.default_rng(seed), Rotor.time_step
    torque = np.repeat(0.8 * random.normal(size=samples // 8), 8)
    angle = speed = wheel = turned = z = 0.0
    angles = []
    for drive in torque:
        angles.append(angle)
        for _ in range(4):
            moment, acceleration = shaft(turned, wheel, speed) if kind == "shaft" else (-STIFFNESS * z, 0.0)
            z += h * (speed - (abs(speed) * z + speed * abs(z)) / (2.0 * YIELD))
            speed += h * (drive + moment - DAMPING * speed) / INERTIA
            wheel += h * acceleration
            turned += h * (wheel - speed)
            angle += h * speed
    time = 0.02 * np.arange(samples)
    columns = {"time": time, "torque": torque, "angle": angles + noise * random.normal(size=samples)}
    return Recording({name: torch.tensor(values) for name, values in columns.items()})


def change_at(prepared, effect, gamma, shape):
    """The change by an effect as a function of the signal, as a fit has it."""
    (name,) = [name for name, port in prepared.ports.items() if port.stands_for == effect.port]
    port = prepared.ports[name]

    def change(signal):
        context = Context(
            port.clock.time, signal[:, :0], (), signal, port.unit, port.channels, port.carries, port.parts,
            port.part_units, port.run,
        )  # fmt: skip
        return effect.change(torch.tensor([gamma], dtype=torch.float64), shape, context)

    return {name: change}


@pytest.mark.parametrize(
    ("kind", "effect", "gamma", "shape"),
    [
        ("shaft", "resonant rate", WHEEL, {"period": PERIOD, "damping": RATIO}),
        ("yielding", "hysteretic rate", STIFFNESS, {"yield_deflection": YIELD}),
    ],
)
def test_the_steps_are_those_of_the_element(kind, effect, gamma, shape):
    prepared = Rotor().prepare(recorded(kind))
    theta = prepared.given
    theta[1:] = 0.0  # the recording starts at rest
    without = float(prepared.residual(theta, {}).abs().max())
    found = prepared.residual(theta, change_at(prepared, FORCE[effect], gamma, shape))
    assert without > 0.05
    assert float(found.abs().max()) < 1e-8


def test_ports_and_units_at_a_joint():
    ports = Rotor().prepare(recorded("shaft")).ports
    kinds = {port.stands_for for port in ports.values() if port.channels == ("moment",)}
    assert kinds == {"rate", "hysteretic rate", "lagged rate", "resonant rate"}
    assert ports["resonant entry of moment"].memory == {"deflection_of_speed": "", "hidden_speed": "speed"}


@pytest.mark.e2e
@pytest.mark.parametrize(
    ("kind", "effect", "sizes"),
    [
        ("shaft", "hidden_mode", {"inertia": (WHEEL, "kg m²"), "period": (PERIOD, "s")}),
        ("yielding", "bouc_wen_hysteresis", {"stiffness": (STIFFNESS, "N m/rad"), "yield_deflection": (YIELD, "rad")}),
    ],
)
def test_an_element_is_named_and_exported(kind, effect, sizes):
    found = diagnose(Rotor(), recorded(kind, noise=5e-4), effects=FAMILY, quick=True)
    (finding,) = found.findings
    assert (finding.effect, finding.channels) == (effect, ("input moment",))
    known = {parameter.name: parameter for parameter in finding.parameters}
    for name, (value, unit) in sizes.items():
        assert known[name].value == pytest.approx(value, rel=0.02)
        assert known[name].unit == unit
    names = {"__name__": "exported"}
    exec(found.model.to_python(__name__), names)
    prepared = names["CorrectedRotor"]().prepare(recorded(kind))
    states = len(prepared.given) - len(prepared.known)
    assert states == len(Rotor.states) + (2 if kind == "shaft" else 1)
    theta = torch.cat([prepared.given[: len(prepared.known)], torch.zeros(states, dtype=torch.float64)])
    assert float(prepared.residual(theta, {}).abs().max()) < 0.01  # of a rotor that turns by radians
