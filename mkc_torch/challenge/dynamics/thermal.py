"""Two heated bodies in a room, each with its heat loss."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from torch import Generator

from mkc_torch.challenge.draws import uniform, whole
from mkc_torch.challenge.dynamics import flows, hidden
from mkc_torch.challenge.dynamics.plant import Array, HiddenTerm, Plant, RunSet, Setting
from mkc_torch.challenge.dynamics.scene import SystemScene
from mkc_torch.challenge.dynamics.signals import excitation, moments

STEP = 5.0
"""s."""


def rate(x: Array, u: Array, p: Array) -> Array:
    return np.array(
        [p[2] * u[0] - p[0] * (x[0] - p[4]), p[3] * u[1] - p[1] * (x[1] - p[4])],
    )


def draw(g: Generator) -> Setting:
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
        rate,
        fine=4,
    )
    runs = whole(g, 1, 2)
    return Setting(plant, trial(g, runs, 320 // runs), trial(g, 1, 200))


def trial(g: Generator, runs: int, samples: int) -> RunSet:
    """Draw heater powers between 0 and 100 W, for warm or cold bodies."""
    time = moments(STEP, samples)
    heaters = [
        [50.0 + uniform(g, 30.0, 48.0) * excitation(g, time, uniform(g, 200.0, 600.0)) for _ in range(runs)]
        for _ in range(2)
    ]
    begin = np.array([[uniform(g, 20.0, 150.0) for _ in range(runs)] for _ in range(2)])
    return RunSet(STEP, np.stack([np.stack(heater, -1) for heater in heaters]), begin)


def glow(state: str) -> hidden.Draw:
    def draw_glow(g: Generator, scene: SystemScene) -> HiddenTerm:
        row = scene.plant.row(state)
        form = flows.radiation(row, scene.plant.parameters["room"], uniform(g, 0.0, 1e-3))
        return HiddenTerm(
            "thermal_loss", "radiation to the walls", (hidden.rate_of(state),), scene.pace(state) / 50.0, form
        )

    return draw_glow


def air_gap(g: Generator, scene: SystemScene) -> HiddenTerm:
    """Heat exchange by air, slightly more than linear in the temperature difference."""
    away = np.abs(scene.state("temperature_1") - scene.state("temperature_2"))
    typical, power = float(np.median(away)), uniform(g, 1.0, 1.25)
    form = flows.exchange(0, 1, lambda head: typical * (head / typical) ** power, uniform(g, 0.7, 1.4))
    places = (hidden.rate_of("temperature_1"), hidden.rate_of("temperature_2"))
    return HiddenTerm("coupling", "convection", places, scene.pace("temperature_1") / typical, form)


def damp(state: str) -> hidden.Draw:
    """Water that evaporates from a wet body."""

    def draw_damp(g: Generator, scene: SystemScene) -> HiddenTerm:  # noqa: ARG001 - one signature for all
        room = scene.plant.parameters["room"]
        form = flows.evaporation(scene.plant.row(state), room, scene.largest(state))
        return HiddenTerm("power_law", "evaporation", (hidden.rate_of(state),), 5.0 * scene.pace(state), form)

    return draw_damp


def rising_air(state: str) -> hidden.Draw:
    """Natural convection along a plate, laminar or turbulent."""

    def draw_air(g: Generator, scene: SystemScene) -> HiddenTerm:
        room, power = scene.plant.parameters["room"], uniform(g, 1.25, 1.4)
        form = flows.natural_convection(scene.plant.row(state), room, scene.largest(state), power)
        return HiddenTerm("power_law", "natural convection", (hidden.rate_of(state),), 5.0 * scene.pace(state), form)

    return draw_air


def plaster(g: Generator, typical: float) -> Callable[[Array], Array]:
    """A wall that stores heat, by conduction and some natural convection."""
    power = uniform(g, 1.0, 1.1)
    return lambda away: away * (away / typical) ** (power - 1.0)


def wax(g: Generator, scene: SystemScene) -> HiddenTerm:
    """Wax that melts in the middle of the temperature range."""
    place = float(np.quantile(scene.state("temperature_1"), uniform(g, 0.3, 0.7)))
    form = flows.melting(0, place, uniform(g, 4.0, 10.0))
    return HiddenTerm("latent_heat", "melting", (hidden.rate_of("temperature_1"),), 3.0, form)


INSIDE = (
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
)
OUTSIDE = (wax,)
