"""A servo joint: in the nominal simulation its angle equals the command."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from torch import Generator

from mkc_torch.challenge.draws import happens, uniform
from mkc_torch.challenge.dynamics import hidden, transducers
from mkc_torch.challenge.dynamics.plant import Array, HiddenTerm, Plant, RunSet, Setting
from mkc_torch.challenge.dynamics.scene import SystemScene
from mkc_torch.challenge.dynamics.signals import excitation, moments, runs_of

STEP = 0.02
"""s."""

PLANNED = 0.08
"""Time constant in s of the planner's second-order smoothing; after a jump a delay would affect a single sample."""

AT = ("angle",)


def rate(x: Array, u: Array, p: Array) -> Array:  # noqa: ARG001 - one signature for all
    """Of no states."""
    return x


def draw(g: Generator) -> Setting:
    plant = Plant(
        "servo",
        (),
        ("command",),
        AT,
        {"angle": "rad"},
        {},
        {"scale": uniform(g, 0.97, 1.03)},
        rate,
        fine=6,
        reads=lambda u, p: p[0] * u,
    )
    return Setting(plant, trial(g, 1, 320), trial(g, 1, 200))


def trial(g: Generator, runs: int, samples: int) -> RunSet:
    """Draw commands of both signs in rad, without jumps, as from a planner."""
    time = moments(STEP, samples)
    wanted = runs_of([uniform(g, 0.7, 1.4) * excitation(g, time, uniform(g, 0.8, 2.0)) for _ in range(runs)])
    return RunSet(
        STEP, transducers.lagged(transducers.lagged(wanted, STEP, PLANNED), STEP, PLANNED), np.zeros((0, runs))
    )


def late(g: Generator, scene: SystemScene) -> HiddenTerm:
    """Delay of the bus and lag of the servo's loop."""
    pipe = happens(g, 0.5)
    form = "transport" if pipe else "four lags in series"
    change = transducers.transport if pipe else transducers.lags(4)
    return HiddenTerm("delay", form, AT, 0.03 * scene.length, outputs=change, twins=("input_delay",))


def worn(g: Generator, scene: SystemScene) -> HiddenTerm:  # noqa: ARG001 - one signature for all
    """Backlash of the gear; at the command and at the angle it is the same here."""
    large = 0.3 * scene.largest_input("command")
    return HiddenTerm("backlash", "uneven teeth", (*AT, "input command"), large, outputs=transducers.worn_gear)


def wrong_zero(g: Generator, scene: SystemScene) -> HiddenTerm:  # noqa: ARG001 - one signature for all
    """A horn mounted a tooth off, on an eccentric shaft."""
    change = transducers.wrong_zero(uniform(g, 0.0, 0.1), uniform(g, 0.0, 2.0 * math.pi))
    return HiddenTerm("offset", "zero of an eccentric shaft", AT, 0.2, outputs=change)


def load(g: Generator, scene: SystemScene) -> HiddenTerm:  # noqa: ARG001 - one signature for all
    """A load that deflects the loop."""
    change = transducers.sagging(uniform(g, -0.5, 0.5))
    return HiddenTerm("gravity_sag", "weight on a soft joint", AT, 0.3, outputs=change)


def end_of_range(g: Generator, scene: SystemScene) -> HiddenTerm:
    change = transducers.soft_limit(scene.largest_input("command"), uniform(g, 4.0, 10.0))
    twins = ("input_saturation",)
    return HiddenTerm("output_saturation", "smooth limit", AT, 2.5, outputs=change, twins=twins)


def slow_sensor(g: Generator, scene: SystemScene) -> HiddenTerm:
    return replace(hidden.slow_sensor()(g, scene), twins=("input_lag",))


def trembling(g: Generator, scene: SystemScene) -> HiddenTerm:
    """A machine nearby."""
    omega = 2.0 * math.pi * uniform(g, 5.0, 30.0) / scene.length
    return HiddenTerm("vibration", "sinusoid of time", AT, 0.2, outputs=transducers.shaken(omega))


INSIDE = (late, worn, wrong_zero, load, end_of_range, slow_sensor)
OUTSIDE = (trembling,)
