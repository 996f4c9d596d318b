"""Throws of a ball that a camera follows. Positions are measured, speeds are not."""

from __future__ import annotations

import numpy as np
from torch import Generator

from mkc_torch.challenge.draws import choose, log_uniform, uniform
from mkc_torch.challenge.dynamics import forces, hidden
from mkc_torch.challenge.dynamics.plant import Array, HiddenTerm, Plant, RunSet, Setting
from mkc_torch.challenge.dynamics.scene import SystemScene

STEP = 0.02
"""s."""

GRAVITY = 9.81
RUNS, SAMPLES = 3, 110


def rate(x: Array, u: Array, p: Array) -> Array:  # noqa: ARG001
    _, _, speed, climb = x
    return np.array([speed, climb, np.zeros_like(speed), np.full_like(climb, -GRAVITY)])


def draw(g: Generator) -> Setting:
    plant = Plant(
        "projectile",
        ("distance", "height", "speed", "climb"),
        (),
        ("distance", "height"),
        {"distance": "m", "height": "m", "speed": "m/s", "climb": "m/s"},
        {"distance": "speed", "height": "climb"},
        {},
        rate,
        fine=8,
    )
    return Setting(plant, trial(g, RUNS), trial(g, 1))


def trial(g: Generator, runs: int) -> RunSet:
    """Draw throws at 20 to 75 degrees, in both directions."""
    begin = []
    for _ in range(runs):
        pace, rise, way = uniform(g, 9.0, 18.0), np.radians(uniform(g, 20.0, 75.0)), choose(g, (-1.0, 1.0))
        begin.append([0.0, uniform(g, 0.5, 2.0), way * pace * np.cos(rise), pace * np.sin(rise)])
    return RunSet(STEP, np.zeros((0, SAMPLES, runs)), np.array(begin).T)


PLACES = (hidden.rate_of("speed"), hidden.rate_of("climb"))


def air(g: Generator, scene: SystemScene) -> HiddenTerm:
    """Drag along the velocity, unlike the catalogue's drag along each axis."""
    typical = float(np.median(np.hypot(scene.state("speed"), scene.state("climb"))))
    form = forces.flight_drag((2, 3), typical, log_uniform(g, 1e3, 1e5))
    return HiddenTerm("quadratic_drag", "drag of a sphere along its velocity", PLACES, 0.5, form)


def syrup(g: Generator, scene: SystemScene) -> HiddenTerm:  # noqa: ARG001 - one signature for all
    """Viscous drag along the velocity."""
    typical = float(np.median(np.hypot(scene.state("speed"), scene.state("climb"))))
    return HiddenTerm("linear_drag", "Oseen's drag", PLACES, 0.5, forces.creeping_drag((2, 3), typical))


def tilted_camera(g: Generator, scene: SystemScene) -> HiddenTerm:  # noqa: ARG001 - one signature for all
    """The camera is tilted: both axes turn, and gravity has a component along the first."""

    def turned(values: Array, step: float, size: float) -> Array:  # noqa: ARG001
        item, other = values
        return np.array([np.cos(size) * item + np.sin(size) * other, np.cos(size) * other - np.sin(size) * item])

    return HiddenTerm("constant_force", "tilted camera", (hidden.rate_of("speed"),), 0.5, outputs=turned)


def fading_gust(g: Generator, scene: SystemScene) -> HiddenTerm:
    """A lateral force that decays a little."""
    form = forces.warming_bias(2, uniform(g, 0.1, 0.5) * scene.length, uniform(g, 0.0, 0.15))
    return HiddenTerm("constant_force", "decaying force", (hidden.rate_of("speed"),), 5.0, form, own=1)


def spin(g: Generator, scene: SystemScene) -> HiddenTerm:
    """A ball thrown with spin that decays."""
    form = forces.lift((2, 3), uniform(g, 3.0, 10.0) * scene.length)
    return HiddenTerm("magnus_lift", "lift of a fading spin", PLACES, 0.5, form, own=1)


def gusts(g: Generator, scene: SystemScene) -> HiddenTerm:
    """Lateral gusts."""
    form = forces.hum(2, uniform(g, 2.0, 6.0) / scene.length)
    return HiddenTerm("vibration", "sinusoid of time", (hidden.rate_of("speed"),), 30.0, form, own=2)


INSIDE = (air, air, syrup, spin, tilted_camera, fading_gust, hidden.slow_sensor())
OUTSIDE = (gusts,)
