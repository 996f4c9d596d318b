"""Two tanks, each with a pump and an outlet."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from torch import Generator

from mkc_torch.challenge.draws import choose, uniform, whole
from mkc_torch.challenge.dynamics import flows, forces, hidden
from mkc_torch.challenge.dynamics.plant import Array, HiddenTerm, Plant, RunSet, Setting
from mkc_torch.challenge.dynamics.scene import SystemScene
from mkc_torch.challenge.dynamics.signals import excitation, moments

STEP = 2.0
"""s."""

FLOOR = 1e-4
"""Level below which an outlet counts as dry, m."""


def rate(x: Array, u: Array, p: Array) -> Array:
    out = np.sqrt(np.maximum(x, FLOOR))
    return np.array([p[0] * u[0] - p[2] * out[0], p[1] * u[1] - p[3] * out[1]])


def draw(g: Generator) -> Setting:
    plant = Plant(
        "tanks",
        ("level_1", "level_2"),
        ("pump_1", "pump_2"),
        ("level_1", "level_2"),
        {"level_1": "m", "level_2": "m"},
        {},
        {
            "pump_gain_1": uniform(g, 0.0012, 0.0018),
            "pump_gain_2": uniform(g, 0.0012, 0.0018),
            "outlet_1": uniform(g, 0.009, 0.014),
            "outlet_2": uniform(g, 0.009, 0.014),
        },
        rate,
        fine=4,
    )
    runs = whole(g, 1, 2)
    return Setting(plant, trial(g, runs, 320 // runs), trial(g, 1, 200))


def trial(g: Generator, runs: int, samples: int) -> RunSet:
    """Draw pump voltages between 0.5 and 9.5 V, and initial levels of 0.1 to 0.7 m."""
    time = moments(STEP, samples)
    pumps = [
        [5.0 + uniform(g, 2.5, 4.5) * excitation(g, time, uniform(g, 60.0, 150.0)) for _ in range(runs)]
        for _ in range(2)
    ]
    begin = np.array([[uniform(g, 0.1, 0.7) for _ in range(runs)] for _ in range(2)])
    return RunSet(STEP, np.stack([np.stack(pump, -1) for pump in pumps]), begin)


def pipe_between(g: Generator, scene: SystemScene) -> HiddenTerm:
    """A pipe with a filter, by Darcy and Forchheimer."""
    away = np.abs(scene.state("level_1") - scene.state("level_2"))
    typical, bend = float(np.median(away)), uniform(g, 0.0, 0.5)
    form = flows.exchange(0, 1, lambda head: flows.forchheimer(head, bend / typical), uniform(g, 0.7, 1.4))
    places = (hidden.rate_of("level_1"), hidden.rate_of("level_2"))
    return HiddenTerm("coupling", "Darcy and Forchheimer's pipe", places, scene.pace("level_1") / typical, form)


def dripping_tap(level: str) -> hidden.Draw:
    def draw_tap(g: Generator, scene: SystemScene) -> HiddenTerm:
        form = flows.tap(scene.plant.row(level), uniform(g, 3.0, 8.0) * scene.largest(level))
        return HiddenTerm("constant_force", "tap on a main", (hidden.rate_of(level),), scene.pace(level), form)

    return draw_tap


def gravel(g: Generator, typical: float) -> Callable[[Array], Array]:
    """A gravel wall to a side basin, by Darcy and Forchheimer."""
    bend = uniform(g, 0.0, 0.3) / typical
    return lambda head: flows.forchheimer(head, bend)


def crack(level: str) -> hidden.Draw:
    def draw_crack(g: Generator, scene: SystemScene) -> HiddenTerm:
        form = flows.slot(scene.plant.row(level), scene.largest(level), choose(g, (1.5, 2.5)), uniform(g, 0.0, 0.1))
        return HiddenTerm("power_law", "slot in the wall", (hidden.rate_of(level),), 3.0 * scene.pace(level), form)

    return draw_crack


def wavy_inflow(g: Generator, scene: SystemScene) -> HiddenTerm:
    """Intermittent rain."""
    form = forces.hum(0, uniform(g, 3.0, 15.0) / scene.length)
    return HiddenTerm("vibration", "sinusoid of time", (hidden.rate_of("level_1"),), scene.pace("level_1"), form, own=2)


INSIDE = (
    pipe_between,
    hidden.full_vessel("level_1"),
    hidden.full_vessel("level_2"),
    hidden.gravel_leak("level_1"),
    dripping_tap("level_1"),
    dripping_tap("level_2"),
    crack("level_1"),
    hidden.second_store("level_2", gravel, "side basin"),
    hidden.late_actuator("pump_1"),
    hidden.slow_actuator("pump_2"),
    hidden.weak_actuator("pump_2"),
    hidden.lapped_valve("pump_1"),
    hidden.worn_drive("pump_2"),
    hidden.slow_sensor(),
)
OUTSIDE = (wavy_inflow,)
