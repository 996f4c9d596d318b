"""A pole that hangs from a much heavier trolley. Positions are measured, speeds are not."""

from __future__ import annotations

import numpy as np
from torch import Generator

from mkc_torch.challenge.draws import uniform, whole
from mkc_torch.challenge.dynamics import hidden
from mkc_torch.challenge.dynamics.plant import Array, Plant, RunSet, Setting
from mkc_torch.challenge.dynamics.signals import excitation, moments, runs_of

STEP = 0.05
"""s."""

GRAVITY = 9.81


def rate(x: Array, u: Array, p: Array) -> Array:
    _, speed, angle, turn = x
    drive = p[0] * u[0] - p[1] * speed
    swing = -(drive * np.cos(angle) + GRAVITY * np.sin(angle)) / p[2] - p[3] * turn
    return np.array([speed, drive, turn, swing])


def draw(g: Generator) -> Setting:
    plant = Plant(
        "cart_pole",
        ("position", "speed", "angle", "turn"),
        ("force",),
        ("position", "angle"),
        {"position": "m", "speed": "m/s", "angle": "rad", "turn": "rad/s"},
        {"position": "speed", "angle": "turn"},
        {
            "gain": uniform(g, 0.4, 0.65),
            "drag": uniform(g, 0.3, 0.8),
            "length": uniform(g, 0.7, 1.3),
            "damping": uniform(g, 0.1, 0.3),
        },
        rate,
        fine=12,
    )
    runs = whole(g, 1, 2)
    return Setting(plant, trial(g, plant, runs, 300 // runs), trial(g, plant, 1, 180))


def trial(g: Generator, plant: Plant, runs: int, samples: int) -> RunSet:
    """Draw forces in N with frequencies about that of the pole."""
    time = moments(STEP, samples)
    period = 2.0 * np.pi * np.sqrt(plant.parameters["length"] / GRAVITY)
    forces = [uniform(g, 4.0, 8.0) * excitation(g, time, period) for _ in range(runs)]
    reach = ((-0.2, 0.2), (-0.3, 0.3), (-0.8, 0.8), (-0.5, 0.5))
    begin = np.array([[uniform(g, *ends) for _ in range(runs)] for ends in reach])
    return RunSet(STEP, runs_of(forces), begin)


INSIDE = (
    hidden.dry_friction("turn", "angle"),
    hidden.sticking_friction("turn", "angle"),
    hidden.blunt_drag("turn"),
    hidden.hard_spring("turn", "angle"),
    hidden.bumper("turn", "angle"),
    hidden.magnets("turn", "angle", (4, 6, 8)),
    hidden.steady_wind("turn"),
    hidden.felt_spring("speed", "position"),
    hidden.second_mass("speed", "load that swings along"),
    hidden.late_actuator("force"),
    hidden.squared_actuator("force"),
    hidden.weak_actuator("force"),
    hidden.lapped_valve("force"),
    hidden.worn_drive("force"),
    hidden.slow_sensor(),
)
OUTSIDE = (hidden.machine_nearby("turn"),)
