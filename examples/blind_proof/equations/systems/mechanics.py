"""A motor-driven pendulum, a pole that hangs from a trolley, and throws of a ball."""

from __future__ import annotations

import numpy as np
from torch import Generator

from examples.blind_proof.draws import choose, log_uniform, uniform
from examples.blind_proof.equations import forces, hidden
from examples.blind_proof.equations.integrate import SystemScene
from examples.blind_proof.equations.plant import (
    Array,
    HiddenTerm,
    Plant,
    RunSet,
    Setting,
    excitation,
    moments,
    runs_of,
    setting,
)

PENDULUM_STEP = 0.05
"""s."""


def pendulum_rate(x: Array, u: Array, p: Array) -> Array:
    angle, speed = x
    return np.array([speed, p[2] * u[0] - p[0] * np.sin(angle) - p[1] * speed])


def pendulum_draw(g: Generator) -> Setting:
    plant = Plant(
        "pendulum",
        ("angle", "speed"),
        ("torque",),
        ("angle",),
        {"angle": "rad", "speed": "rad/s"},
        {"angle": "speed"},
        {"stiffness": uniform(g, 6.0, 14.0), "damping": uniform(g, 0.1, 0.5), "gain": uniform(g, 0.8, 1.25)},
        pendulum_rate,
        fine=12,
    )
    return setting(g, plant, pendulum_trial, most_runs=3, samples=360, later=200)


def pendulum_trial(g: Generator, plant: Plant, runs: int, samples: int) -> RunSet:
    """Draw swings from an initial deflection, with torques in N m at frequencies about that of the pendulum."""
    time = moments(PENDULUM_STEP, samples)
    period = 2.0 * np.pi / np.sqrt(plant.parameters["stiffness"])
    torques = [uniform(g, 2.0, 5.0) * excitation(g, time, period) for _ in range(runs)]
    begin = np.array([[uniform(g, -1.2, 1.2) for _ in range(runs)], [uniform(g, -1.0, 1.0) for _ in range(runs)]])
    return RunSet(PENDULUM_STEP, runs_of(torques), begin)


PENDULUM = hidden.System(
    pendulum_draw,
    pendulum_trial,
    inside=(
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
    ),
    outside=(hidden.machine_nearby("speed"),),
)


CART_POLE_STEP = 0.05
"""s."""

GRAVITY = 9.81


def cart_pole_rate(x: Array, u: Array, p: Array) -> Array:
    _, speed, angle, turn = x
    drive = p[0] * u[0] - p[1] * speed
    swing = -(drive * np.cos(angle) + GRAVITY * np.sin(angle)) / p[2] - p[3] * turn
    return np.array([speed, drive, turn, swing])


def cart_pole_draw(g: Generator) -> Setting:
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
        cart_pole_rate,
        fine=12,
    )
    return setting(g, plant, cart_pole_trial, most_runs=2, samples=300, later=180)


def cart_pole_trial(g: Generator, plant: Plant, runs: int, samples: int) -> RunSet:
    """Draw forces in N with frequencies about that of the pole."""
    time = moments(CART_POLE_STEP, samples)
    period = 2.0 * np.pi * np.sqrt(plant.parameters["length"] / GRAVITY)
    forces = [uniform(g, 4.0, 8.0) * excitation(g, time, period) for _ in range(runs)]
    reach = ((-0.2, 0.2), (-0.3, 0.3), (-0.8, 0.8), (-0.5, 0.5))
    begin = np.array([[uniform(g, *ends) for _ in range(runs)] for ends in reach])
    return RunSet(CART_POLE_STEP, runs_of(forces), begin)


CART_POLE = hidden.System(
    cart_pole_draw,
    cart_pole_trial,
    inside=(
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
    ),
    outside=(hidden.machine_nearby("turn"),),
)


PROJECTILE_STEP = 0.02
"""s."""

THROWS, THROW_SAMPLES = 3, 110


def projectile_rate(x: Array, u: Array, p: Array) -> Array:
    _, _, speed, climb = x
    return np.array([speed, climb, np.zeros_like(speed), np.full_like(climb, -GRAVITY)])


def projectile_draw(g: Generator) -> Setting:
    plant = Plant(
        "projectile",
        ("distance", "height", "speed", "climb"),
        (),
        ("distance", "height"),
        {"distance": "m", "height": "m", "speed": "m/s", "climb": "m/s"},
        {"distance": "speed", "height": "climb"},
        {},
        projectile_rate,
        fine=8,
    )
    return Setting(
        plant, projectile_trial(g, plant, THROWS, THROW_SAMPLES), projectile_trial(g, plant, 1, THROW_SAMPLES)
    )


def projectile_trial(g: Generator, plant: Plant, runs: int, samples: int) -> RunSet:
    """Draw throws at 20 to 75 degrees, in both directions."""
    begin = []
    for _ in range(runs):
        pace, rise, way = uniform(g, 9.0, 18.0), np.radians(uniform(g, 20.0, 75.0)), choose(g, (-1.0, 1.0))
        begin.append([0.0, uniform(g, 0.5, 2.0), way * pace * np.cos(rise), pace * np.sin(rise)])
    return RunSet(PROJECTILE_STEP, np.zeros((0, THROW_SAMPLES, runs)), np.array(begin).T)


THROW_PORTS = (hidden.rate_of("speed"), hidden.rate_of("climb"))


def air(g: Generator, scene: SystemScene) -> HiddenTerm:
    """Drag along the velocity, unlike the catalogue's drag along each axis."""
    typical = float(np.median(np.hypot(scene.state("speed"), scene.state("climb"))))
    form = forces.flight_drag((2, 3), typical, log_uniform(g, 1e3, 1e5))
    return HiddenTerm("quadratic_drag", "drag of a sphere along its velocity", THROW_PORTS, 0.5, form)


def syrup(g: Generator, scene: SystemScene) -> HiddenTerm:
    """Viscous drag along the velocity."""
    typical = float(np.median(np.hypot(scene.state("speed"), scene.state("climb"))))
    return HiddenTerm("linear_drag", "Oseen's drag", THROW_PORTS, 0.5, forces.creeping_drag((2, 3), typical))


def tilted_camera(g: Generator, scene: SystemScene) -> HiddenTerm:
    """The camera is tilted: both axes turn, and gravity has a component along the first."""

    def turned(values: Array, step: float, size: float) -> Array:
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
    return HiddenTerm("magnus_lift", "lift of a fading spin", THROW_PORTS, 0.5, form, own=1)


def gusts(g: Generator, scene: SystemScene) -> HiddenTerm:
    """Lateral gusts."""
    form = forces.hum(2, uniform(g, 2.0, 6.0) / scene.length)
    return HiddenTerm("vibration", "sinusoid of time", (hidden.rate_of("speed"),), 30.0, form, own=2)


PROJECTILE = hidden.System(
    projectile_draw,
    projectile_trial,
    inside=(air, air, syrup, spin, tilted_camera, fading_gust, hidden.slow_sensor()),
    outside=(gusts,),
)
