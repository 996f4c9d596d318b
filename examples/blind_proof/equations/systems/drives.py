"""A motor with a load, and a servo joint whose angle equals the command in the nominal simulation."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from torch import Generator

from examples.blind_proof.draws import uniform
from examples.blind_proof.equations import forces, hidden, transducers
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

MOTOR_STEP = 0.02
"""s."""


def motor_rate(x: Array, u: Array, p: Array) -> Array:
    _, speed, current = x
    return np.array([speed, p[0] * current - p[1] * speed, p[2] * u[0] - p[3] * current - p[4] * speed])


def motor_draw(g: Generator) -> Setting:
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
        motor_rate,
        fine=10,
    )
    return setting(g, plant, motor_trial, most_runs=2, samples=320, later=200)


def motor_trial(g: Generator, plant: Plant, runs: int, samples: int) -> RunSet:
    """Draw voltages of both signs; the motor starts at standstill or in motion."""
    time = moments(MOTOR_STEP, samples)
    voltages = [uniform(g, 6.0, 12.0) * excitation(g, time, uniform(g, 0.8, 2.0)) for _ in range(runs)]
    reach = ((0.0, 6.0), (-3.0, 3.0), (-0.5, 0.5))
    begin = np.array([[uniform(g, *ends) for _ in range(runs)] for ends in reach])
    return RunSet(MOTOR_STEP, runs_of(voltages), begin)


def gear_teeth(g: Generator, scene: SystemScene) -> HiddenTerm:
    """Friction of gear teeth in proportion to the motor's torque."""
    form = forces.teeth(1, uniform(g, 0.005, 0.015) * scene.largest("angle"), 2, 1.0 / scene.typical("current"))
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


MOTOR = hidden.System(
    motor_draw,
    motor_trial,
    inside=(
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
    ),
    outside=(hot_windings,),
)


SERVO_STEP = 0.02
"""s."""

SERVO_PLANNED = 0.08
"""Time constant in s of the planner's second-order smoothing; after a jump a delay would affect a single sample."""

SERVO_AT = ("angle",)


def servo_rate(x: Array, u: Array, p: Array) -> Array:
    """Of no states."""
    return x


def servo_draw(g: Generator) -> Setting:
    plant = Plant(
        "servo",
        (),
        ("command",),
        SERVO_AT,
        {"angle": "rad"},
        {},
        {"scale": uniform(g, 0.97, 1.03)},
        servo_rate,
        fine=6,
        reads=lambda u, p: p[0] * u,
    )
    return Setting(plant, servo_trial(g, plant, 1, 320), servo_trial(g, plant, 1, 200))


def servo_trial(g: Generator, plant: Plant, runs: int, samples: int) -> RunSet:
    """Draw commands of both signs in rad, without jumps, as from a planner."""
    time = moments(SERVO_STEP, samples)
    wanted = runs_of([uniform(g, 0.7, 1.4) * excitation(g, time, uniform(g, 0.8, 2.0)) for _ in range(runs)])
    once = transducers.lagged(wanted, SERVO_STEP, SERVO_PLANNED)
    return RunSet(SERVO_STEP, transducers.lagged(once, SERVO_STEP, SERVO_PLANNED), np.zeros((0, runs)))


def late(g: Generator, scene: SystemScene) -> HiddenTerm:
    """Delay of the bus and lag of the servo's loop."""
    form, change = hidden.late(g)
    return HiddenTerm("delay", form, SERVO_AT, 0.03 * scene.length, outputs=change, twins=("input_delay",))


def worn(g: Generator, scene: SystemScene) -> HiddenTerm:
    """Backlash of the gear; at the command and at the angle it is the same here."""
    large = 0.3 * scene.largest_input("command")
    return HiddenTerm("backlash", "uneven teeth", (*SERVO_AT, "input command"), large, outputs=transducers.worn_gear)


def wrong_zero(g: Generator, scene: SystemScene) -> HiddenTerm:
    """A horn mounted a tooth off, on an eccentric shaft."""
    change = transducers.wrong_zero(uniform(g, 0.0, 0.1), uniform(g, 0.0, 2.0 * math.pi))
    return HiddenTerm("offset", "zero of an eccentric shaft", SERVO_AT, 0.2, outputs=change)


def load(g: Generator, scene: SystemScene) -> HiddenTerm:
    """A load that deflects the loop."""
    change = transducers.sagging(uniform(g, -0.5, 0.5))
    return HiddenTerm("gravity_sag", "weight on a soft joint", SERVO_AT, 0.3, outputs=change)


def end_of_range(g: Generator, scene: SystemScene) -> HiddenTerm:
    change = transducers.soft_limit(scene.largest_input("command"), uniform(g, 4.0, 10.0))
    twins = ("input_saturation",)
    return HiddenTerm("output_saturation", "smooth limit", SERVO_AT, 2.5, outputs=change, twins=twins)


def slow_sensor(g: Generator, scene: SystemScene) -> HiddenTerm:
    return replace(hidden.slow_sensor()(g, scene), twins=("input_lag",))


def trembling(g: Generator, scene: SystemScene) -> HiddenTerm:
    """A machine nearby."""
    omega = 2.0 * math.pi * uniform(g, 5.0, 30.0) / scene.length
    return HiddenTerm("vibration", "sinusoid of time", SERVO_AT, 0.2, outputs=transducers.shaken(omega))


SERVO = hidden.System(
    servo_draw, servo_trial, inside=(late, worn, wrong_zero, load, end_of_range, slow_sensor), outside=(trembling,)
)
