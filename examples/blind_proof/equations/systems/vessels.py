"""Two tanks, each with a pump and an outlet, and two heated bodies in a room."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from torch import Generator

from examples.blind_proof.draws import choose, uniform
from examples.blind_proof.equations import flows, forces, hidden
from examples.blind_proof.equations.integrate import SystemScene
from examples.blind_proof.equations.plant import Array, HiddenTerm, Plant, RunSet, Setting, excitation, moments, setting

TANKS_STEP = 2.0
"""s."""

TANKS_FLOOR = 1e-4
"""Level below which an outlet counts as dry, m."""


def tanks_rate(x: Array, u: Array, p: Array) -> Array:
    out = np.sqrt(np.maximum(x, TANKS_FLOOR))
    return np.array([p[0] * u[0] - p[2] * out[0], p[1] * u[1] - p[3] * out[1]])


def tanks_draw(g: Generator) -> Setting:
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
        tanks_rate,
        fine=4,
    )
    return setting(g, plant, tanks_trial, most_runs=2, samples=320, later=200)


def tanks_trial(g: Generator, plant: Plant, runs: int, samples: int) -> RunSet:
    """Draw pump voltages between 0.5 and 9.5 V, and initial levels of 0.1 to 0.7 m."""
    time = moments(TANKS_STEP, samples)
    pumps = [
        [5.0 + uniform(g, 2.5, 4.5) * excitation(g, time, uniform(g, 60.0, 150.0)) for _ in range(runs)]
        for _ in range(2)
    ]
    begin = np.array([[uniform(g, 0.1, 0.7) for _ in range(runs)] for _ in range(2)])
    return RunSet(TANKS_STEP, np.stack([np.stack(pump, -1) for pump in pumps]), begin)


def pipe_between(g: Generator, scene: SystemScene) -> HiddenTerm:
    """A pipe with a filter, by Darcy and Forchheimer."""
    away = np.abs(scene.state("level_1") - scene.state("level_2"))
    typical, bend = float(np.median(away)), uniform(g, 0.0, 0.5)
    form = flows.exchange(0, 1, lambda head: flows.forchheimer(head, bend / typical), uniform(g, 0.7, 1.4))
    places = (hidden.rate_of("level_1"), hidden.rate_of("level_2"))
    return HiddenTerm("coupling", "Darcy and Forchheimer's pipe", places, scene.pace("level_1") / typical, form)


@hidden.drawn_for
def dripping_tap(g: Generator, scene: SystemScene, level: str) -> HiddenTerm:
    form = flows.tap(scene.plant.row(level), uniform(g, 3.0, 8.0) * scene.largest(level))
    return HiddenTerm("constant_force", "tap on a main", (hidden.rate_of(level),), scene.pace(level), form)


def gravel(g: Generator, typical: float) -> Callable[[Array], Array]:
    """A gravel wall to a side basin, by Darcy and Forchheimer."""
    bend = uniform(g, 0.0, 0.3) / typical
    return lambda head: flows.forchheimer(head, bend)


@hidden.drawn_for
def crack(g: Generator, scene: SystemScene, level: str) -> HiddenTerm:
    form = flows.slot(scene.plant.row(level), scene.largest(level), choose(g, (1.5, 2.5)), uniform(g, 0.0, 0.1))
    return HiddenTerm("power_law", "slot in the wall", (hidden.rate_of(level),), 3.0 * scene.pace(level), form)


def wavy_inflow(g: Generator, scene: SystemScene) -> HiddenTerm:
    """Intermittent rain."""
    form = forces.hum(0, uniform(g, 3.0, 15.0) / scene.length)
    return HiddenTerm("vibration", "sinusoid of time", (hidden.rate_of("level_1"),), scene.pace("level_1"), form, own=2)


TANKS = hidden.System(
    tanks_draw,
    tanks_trial,
    inside=(
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
    ),
    outside=(wavy_inflow,),
)


THERMAL_STEP = 5.0
"""s."""


def thermal_rate(x: Array, u: Array, p: Array) -> Array:
    return np.array([p[2] * u[0] - p[0] * (x[0] - p[4]), p[3] * u[1] - p[1] * (x[1] - p[4])])


def thermal_draw(g: Generator) -> Setting:
    plant = Plant(
        "thermal",
        ("temperature_1", "temperature_2"),
        ("heater_1", "heater_2"),
        ("temperature_1", "temperature_2"),
        {"temperature_1": "°C", "temperature_2": "°C"},
        {},
        {
            "loss_1": uniform(g, 0.003, 0.006),
            "loss_2": uniform(g, 0.003, 0.006),
            "gain_1": uniform(g, 0.006, 0.012),
            "gain_2": uniform(g, 0.006, 0.012),
            "room": uniform(g, 15.0, 25.0),
        },
        thermal_rate,
        fine=4,
    )
    return setting(g, plant, thermal_trial, most_runs=2, samples=320, later=200)


def thermal_trial(g: Generator, plant: Plant, runs: int, samples: int) -> RunSet:
    """Draw heater powers between 0 and 100 W, for warm or cold bodies."""
    time = moments(THERMAL_STEP, samples)
    heaters = [
        [50.0 + uniform(g, 30.0, 48.0) * excitation(g, time, uniform(g, 200.0, 600.0)) for _ in range(runs)]
        for _ in range(2)
    ]
    begin = np.array([[uniform(g, 20.0, 150.0) for _ in range(runs)] for _ in range(2)])
    return RunSet(THERMAL_STEP, np.stack([np.stack(heater, -1) for heater in heaters]), begin)


@hidden.drawn_for
def glow(g: Generator, scene: SystemScene, state: str) -> HiddenTerm:
    row = scene.plant.row(state)
    form = flows.radiation(row, scene.plant.parameters["room"], uniform(g, 0.0, 1e-3))
    large = scene.pace(state) / 50.0
    return HiddenTerm("thermal_loss", "radiation to the walls", (hidden.rate_of(state),), large, form)


def air_gap(g: Generator, scene: SystemScene) -> HiddenTerm:
    """Heat exchange by air, slightly more than linear in the temperature difference."""
    away = np.abs(scene.state("temperature_1") - scene.state("temperature_2"))
    typical, power = float(np.median(away)), uniform(g, 1.0, 1.25)
    form = flows.exchange(0, 1, lambda head: typical * (head / typical) ** power, uniform(g, 0.7, 1.4))
    places = (hidden.rate_of("temperature_1"), hidden.rate_of("temperature_2"))
    return HiddenTerm("coupling", "convection", places, scene.pace("temperature_1") / typical, form)


@hidden.drawn_for
def damp(g: Generator, scene: SystemScene, state: str) -> HiddenTerm:
    """Water that evaporates from a wet body."""
    room = scene.plant.parameters["room"]
    form = flows.evaporation(scene.plant.row(state), room, scene.largest(state))
    return HiddenTerm("power_law", "evaporation", (hidden.rate_of(state),), 5.0 * scene.pace(state), form)


@hidden.drawn_for
def rising_air(g: Generator, scene: SystemScene, state: str) -> HiddenTerm:
    """Natural convection along a plate, laminar or turbulent."""
    room, power = scene.plant.parameters["room"], uniform(g, 1.25, 1.4)
    form = flows.natural_convection(scene.plant.row(state), room, scene.largest(state), power)
    return HiddenTerm("power_law", "natural convection", (hidden.rate_of(state),), 5.0 * scene.pace(state), form)


def plaster(g: Generator, typical: float) -> Callable[[Array], Array]:
    """A wall that stores heat, by conduction and some natural convection."""
    power = uniform(g, 1.0, 1.1)
    return lambda away: away * (away / typical) ** (power - 1.0)


def wax(g: Generator, scene: SystemScene) -> HiddenTerm:
    """Wax that melts in the middle of the temperature range."""
    place = float(np.quantile(scene.state("temperature_1"), uniform(g, 0.3, 0.7)))
    form = flows.melting(0, place, uniform(g, 4.0, 10.0))
    return HiddenTerm("latent_heat", "melting", (hidden.rate_of("temperature_1"),), 3.0, form)


THERMAL = hidden.System(
    thermal_draw,
    thermal_trial,
    inside=(
        glow("temperature_1"),
        glow("temperature_2"),
        air_gap,
        damp("temperature_1"),
        rising_air("temperature_2"),
        hidden.second_store("temperature_1", plaster, "wall of plaster"),
        hidden.second_store("temperature_2", plaster, "wall of plaster"),
        hidden.late_actuator("heater_1"),
        hidden.slow_actuator("heater_2"),
        hidden.squared_actuator("heater_1"),
        hidden.weak_actuator("heater_2"),
        hidden.lapped_valve("heater_1"),
        hidden.slow_sensor(),
    ),
    outside=(wax,),
)
