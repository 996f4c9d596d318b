"""A motor-driven pendulum. Only the angle is measured."""

from __future__ import annotations

import numpy as np
from torch import Generator

from mkc_torch.challenge.draws import uniform, whole
from mkc_torch.challenge.dynamics import hidden
from mkc_torch.challenge.dynamics.plant import Array, Plant, RunSet, Setting
from mkc_torch.challenge.dynamics.signals import excitation, moments, runs_of

STEP = 0.05
"""s."""


def rate(x: Array, u: Array, p: Array) -> Array:
    angle, speed = x
    return np.array([speed, p[2] * u[0] - p[0] * np.sin(angle) - p[1] * speed])


def draw(g: Generator) -> Setting:
    plant = Plant(
        "pendulum",
        ("angle", "speed"),
        ("torque",),
        ("angle",),
        {"angle": "rad", "speed": "rad/s"},
        {"angle": "speed"},
        {"stiffness": uniform(g, 6.0, 14.0), "damping": uniform(g, 0.1, 0.5), "gain": uniform(g, 0.8, 1.25)},
        rate,
        fine=12,
    )
    runs = whole(g, 1, 3)
    return Setting(plant, trial(g, plant, runs, 360 // runs), trial(g, plant, 1, 200))


def trial(g: Generator, plant: Plant, runs: int, samples: int) -> RunSet:
    """Draw swings from an initial deflection, with torques in N m at frequencies about that of the pendulum."""
    time = moments(STEP, samples)
    period = 2.0 * np.pi / np.sqrt(plant.parameters["stiffness"])
    torques = [uniform(g, 2.0, 5.0) * excitation(g, time, period) for _ in range(runs)]
    begin = np.array([[uniform(g, -1.2, 1.2) for _ in range(runs)], [uniform(g, -1.0, 1.0) for _ in range(runs)]])
    return RunSet(STEP, runs_of(torques), begin)


INSIDE = (
    hidden.dry_friction("speed", "angle"),
    hidden.sticking_friction("speed", "angle"),
    hidden.blunt_drag("speed"),
    hidden.hard_spring("speed", "angle"),
    hidden.bumper("speed", "angle"),
    hidden.magnets("speed", "angle", (4, 6, 8)),
    hidden.steady_wind("speed"),
    hidden.warm_bias("speed"),
    hidden.second_mass("speed", "soft joint"),
    hidden.late_actuator("torque"),
    hidden.slow_actuator("torque"),
    hidden.squared_actuator("torque"),
    hidden.weak_actuator("torque"),
    hidden.lapped_valve("torque"),
    hidden.bushing("speed", "angle"),
    hidden.slow_sensor(),
)
OUTSIDE = (hidden.machine_nearby("speed"),)
