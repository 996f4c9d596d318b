"""A motor with a load. Angle and current are measured, the speed is not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from torch import Generator

from mkc_torch.challenge.draws import uniform, whole
from mkc_torch.challenge.dynamics import forces, friction, hidden
from mkc_torch.challenge.dynamics.plant import Array, HiddenTerm, Plant, RunSet, Setting
from mkc_torch.challenge.dynamics.scene import SystemScene
from mkc_torch.challenge.dynamics.signals import excitation, moments, runs_of

STEP = 0.02
"""s."""


def rate(x: Array, u: Array, p: Array) -> Array:
    _, speed, current = x
    return np.array([speed, p[0] * current - p[1] * speed, p[2] * u[0] - p[3] * current - p[4] * speed])


def draw(g: Generator) -> Setting:
    plant = Plant(
        "motor",
        ("angle", "speed", "current"),
        ("voltage",),
        ("angle", "current"),
        {"angle": "rad", "speed": "rad/s", "current": "A"},
        {"angle": "speed"},
        {
            "torque": uniform(g, 8.0, 16.0),
            "damping": uniform(g, 0.3, 1.0),
            "drive": uniform(g, 5.0, 9.0),
            "resistance": uniform(g, 9.0, 15.0),
            "back_emf": uniform(g, 0.4, 0.9),
        },
        rate,
        fine=10,
    )
    runs = whole(g, 1, 2)
    return Setting(plant, trial(g, runs, 320 // runs), trial(g, 1, 200))


def trial(g: Generator, runs: int, samples: int) -> RunSet:
    """Draw voltages of both signs; the motor starts at standstill or in motion."""
    time = moments(STEP, samples)
    voltages = [uniform(g, 6.0, 12.0) * excitation(g, time, uniform(g, 0.8, 2.0)) for _ in range(runs)]
    reach = ((0.0, 6.0), (-3.0, 3.0), (-0.5, 0.5))
    begin = np.array([[uniform(g, *ends) for _ in range(runs)] for ends in reach])
    return RunSet(STEP, runs_of(voltages), begin)


def gear_teeth(g: Generator, scene: SystemScene) -> HiddenTerm:
    """Friction of gear teeth in proportion to the motor's torque."""
    form = friction.teeth(1, uniform(g, 0.005, 0.015) * scene.largest("angle"), 2, 1.0 / scene.typical("current"))
    large = 0.3 * scene.pace("speed")
    return HiddenTerm("load_dependent_friction", "teeth by bristles", (hidden.rate_of("speed"),), large, form, own=1)


def oil(g: Generator, typical: float) -> Callable[[Array], Array]:
    """A fluid coupling whose torque grows more than linearly with the slip."""
    share = uniform(g, 0.0, 0.1)
    return lambda slip: slip * (1.0 + share * slip / typical)


def hot_windings(g: Generator, scene: SystemScene) -> HiddenTerm:
    """Torque that decreases while the windings heat up."""
    heat = scene.typical("current") ** 2
    form = forces.fading_drive(1, 2, scene.plant.parameters["torque"], uniform(g, 0.1, 0.5) * scene.length)
    return HiddenTerm("fading_drive", "hot windings", (hidden.rate_of("speed"),), 1.0 / heat, form, own=1)


INSIDE = (
    hidden.dry_friction("speed", "angle"),
    hidden.sticking_friction("speed", "angle"),
    gear_teeth,
    hidden.blunt_drag("speed"),
    hidden.magnets("speed", "angle", (2, 3, 4, 6)),
    hidden.warm_bias("speed"),
    hidden.second_mass("speed", "soft shaft"),
    hidden.second_store("speed", oil, "flywheel in oil"),
    hidden.late_actuator("voltage"),
    hidden.slow_actuator("voltage"),
    hidden.weak_actuator("voltage"),
    hidden.lapped_valve("voltage"),
    hidden.slow_sensor(),
)
OUTSIDE = (hot_windings,)
