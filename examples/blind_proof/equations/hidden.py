"""Effects that can be hidden in several systems, scaled to a scene, with the names of the catalogue."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Concatenate, ParamSpec

import numpy as np
from torch import Generator

from examples.blind_proof.draws import choose, happens, log_uniform, uniform
from examples.blind_proof.equations import flows, forces, transducers
from examples.blind_proof.equations.forces import bristles, rubber
from examples.blind_proof.equations.integrate import SystemScene
from examples.blind_proof.equations.plant import Array, HiddenTerm, Setting, SignalChange, Trial

P = ParamSpec("P")

Draw = Callable[[Generator, SystemScene], HiddenTerm]

Exchange = Callable[[Generator, float], Callable[[Array], Array]]
"""Returns a function of differences ≥ 0 in the same unit, given a typical difference."""


def drawn_for(term: Callable[Concatenate[Generator, SystemScene, P], HiddenTerm]) -> Callable[P, Draw]:
    """Turn ``term(g, scene, *names)`` into a function that takes the names in a system and returns a draw."""

    def named(*names: P.args, **more: P.kwargs) -> Draw:
        return lambda g, scene: term(g, scene, *names, **more)

    return named


def rate_of(state: str) -> str:
    """Return the name of the port in a diagnosis."""
    return f"rate of {state}"


@drawn_for
def dry_friction(g: Generator, scene: SystemScene, speed: str, position: str) -> HiddenTerm:
    form = bristles(scene.plant.row(speed), uniform(g, 0.008, 0.015) * scene.largest(position), scene.typical(speed))
    large = 0.5 * scene.pace(speed)
    return HiddenTerm("coulomb_friction", "LuGre without a rise", (rate_of(speed),), large, form, own=1)


@drawn_for
def sticking_friction(g: Generator, scene: SystemScene, speed: str, position: str) -> HiddenTerm:
    deflection = uniform(g, 0.008, 0.015) * scene.largest(position)
    slow = uniform(g, 0.3, 0.8) * scene.typical(speed)
    form = bristles(scene.plant.row(speed), deflection, slow, rise=uniform(g, 1.0, 2.5))
    large = 0.4 * scene.pace(speed)
    return HiddenTerm("stribeck_friction", "LuGre with Tustin's rise", (rate_of(speed),), large, form, own=1)


@drawn_for
def blunt_drag(g: Generator, scene: SystemScene, speed: str) -> HiddenTerm:
    typical = scene.typical(speed)
    form = forces.sphere_drag(scene.plant.row(speed), typical, log_uniform(g, 500.0, 5e4))
    large = 0.7 * scene.pace(speed) / typical
    return HiddenTerm("quadratic_drag", "drag coefficient of Reynolds' number", (rate_of(speed),), large, form)


@drawn_for
def hard_spring(g: Generator, scene: SystemScene, speed: str, position: str) -> HiddenTerm:
    reach = scene.largest(position)
    form = forces.hardening(scene.plant.row(speed), scene.plant.row(position), uniform(g, 0.6, 1.2) * reach)
    large = scene.pace(speed) / reach**3
    return HiddenTerm("cubic_stiffness", "hyperbolic sine", (rate_of(speed),), large, form)


@drawn_for
def bumper(g: Generator, scene: SystemScene, speed: str, position: str) -> HiddenTerm:
    x, reach = scene.state(position), scene.largest(position)
    further = 1.0 if x.max() >= -x.min() else -1.0
    ways = (1.0, -1.0) if happens(g, 0.5) else (further,)
    form = forces.contact(scene.plant.row(speed), scene.plant.row(position), uniform(g, 0.55, 0.85) * reach, ways)
    large = 20.0 * scene.pace(speed) / (0.2 * reach) ** 1.5
    return HiddenTerm("hard_stop", "Hunt and Crossley's contact", (rate_of(speed),), large, form)


@drawn_for
def magnets(g: Generator, scene: SystemScene, speed: str, angle: str, orders: tuple[int, ...]) -> HiddenTerm:
    order, phase, second = choose(g, orders), uniform(g, 0.0, 2.0 * math.pi), uniform(g, 0.1, 0.25)
    form = forces.cogging(scene.plant.row(speed), scene.plant.row(angle), order, phase, second)
    large = 0.7 * scene.pace(speed)
    return HiddenTerm("position_periodic_force", "cogging, second harmonic", (rate_of(speed),), large, form)


@drawn_for
def steady_wind(g: Generator, scene: SystemScene, speed: str) -> HiddenTerm:
    form = forces.wind(scene.plant.row(speed), uniform(g, 4.0, 10.0) * scene.largest(speed))
    return HiddenTerm("constant_force", "steady wind", (rate_of(speed),), scene.pace(speed), form)


@drawn_for
def warm_bias(g: Generator, scene: SystemScene, speed: str) -> HiddenTerm:
    form = forces.warming_bias(scene.plant.row(speed), uniform(g, 0.1, 0.5) * scene.length, uniform(g, 0.0, 0.15))
    return HiddenTerm("constant_force", "bias that warms up", (rate_of(speed),), scene.pace(speed), form, own=1)


def _at_input(scene: SystemScene, name: str, effect: str, form: str, large: float, change: SignalChange) -> HiddenTerm:
    """Return an effect that changes one input."""
    changed = transducers.only(scene.plant.inputs.index(name), change)
    return HiddenTerm(effect, form, (f"input {name}",), large, inputs=changed)


def late(g: Generator) -> tuple[str, SignalChange]:
    """Draw the form of a delay, and the change that it makes."""
    if happens(g, 0.5):
        return "transport", transducers.transport
    return "four lags in series", transducers.lags(4)


@drawn_for
def late_actuator(g: Generator, scene: SystemScene, name: str) -> HiddenTerm:
    form, change = late(g)
    return _at_input(scene, name, "input_delay", form, 0.05 * scene.length, change)


@drawn_for
def slow_actuator(g: Generator, scene: SystemScene, name: str) -> HiddenTerm:
    form = "two lags, of which one is short"
    return _at_input(scene, name, "input_lag", form, 0.05 * scene.length, transducers.follower)


@drawn_for
def squared_actuator(g: Generator, scene: SystemScene, name: str) -> HiddenTerm:
    change = transducers.squared(scene.largest_input(name), uniform(g, 1.8, 2.2))
    return _at_input(scene, name, "input_square", "power near the square", 1.0, change)


@drawn_for
def weak_actuator(g: Generator, scene: SystemScene, name: str) -> HiddenTerm:
    change = transducers.soft_limit(scene.largest_input(name), uniform(g, 4.0, 10.0))
    return _at_input(scene, name, "input_saturation", "smooth limit", 2.5, change)


@drawn_for
def lapped_valve(g: Generator, scene: SystemScene, name: str) -> HiddenTerm:
    change = transducers.soft_gap(scene.largest_input(name))
    return _at_input(scene, name, "dead_zone", "smooth overlap", 0.4, change)


@drawn_for
def worn_drive(g: Generator, scene: SystemScene, name: str) -> HiddenTerm:
    change = transducers.worn_linkage(scene.largest_input(name))
    return _at_input(scene, name, "backlash", "several gaps in series", 0.4, change)


@drawn_for
def bushing(g: Generator, scene: SystemScene, speed: str, position: str) -> HiddenTerm:
    reach = scene.largest(position)
    form = rubber(scene.plant.row(speed), tuple(reach * uniform(g, 0.1, 0.5) for _ in range(3)))
    large = 2.0 * scene.pace(speed) / reach
    return HiddenTerm("bouc_wen_hysteresis", "elements with several yields", (rate_of(speed),), large, form, own=3)


@drawn_for
def felt_spring(g: Generator, scene: SystemScene, speed: str, position: str) -> HiddenTerm:
    form = forces.felt(scene.plant.row(speed), scene.plant.row(position), scene.largest(position), uniform(g, 1.8, 2.4))
    return HiddenTerm("power_law", "spring of felt", (rate_of(speed),), 2.0 * scene.pace(speed), form)


@drawn_for
def second_store(g: Generator, scene: SystemScene, state: str, exchange: Exchange, name: str) -> HiddenTerm:
    """Draw a second store that exchanges with a state, with delay.

    Args:
        state: state that it is connected to.
        exchange: draws the flow between them, given a typical difference.
        name: name of the store.
    """
    constant = log_uniform(g, 0.02, 0.1) * scene.length
    row, x = scene.plant.row(state), scene.state(state)
    away = x - transducers.lagged(x[None], scene.trial.step / scene.plant.fine, constant)[0]
    head = exchange(g, float(np.abs(away).mean()))
    form = flows.second_store(row, lambda there: head(there) / constant)
    return HiddenTerm("hidden_lag", name, (rate_of(state),), 2.0, form, own=1, begin=flows.like(row))


@drawn_for
def second_mass(g: Generator, scene: SystemScene, speed: str, name: str) -> HiddenTerm:
    row = scene.plant.row(speed)
    omega = 2.0 * math.pi / (log_uniform(g, 0.06, 0.25) * scene.length)
    reach = scene.pace(speed) / omega**2
    form = flows.second_mass(row, omega, log_uniform(g, 0.02, 0.1), uniform(g, 0.005, 0.02) / reach**2)
    return HiddenTerm("hidden_mode", name, (rate_of(speed),), 2.0, form, own=2, begin=flows.unstretched(row))


@drawn_for
def slow_sensor(g: Generator, scene: SystemScene) -> HiddenTerm:
    large, outputs = 0.03 * scene.length, scene.plant.outputs
    return HiddenTerm("sensor_lag", "two lags in series", outputs, large, outputs=transducers.housing)


@drawn_for
def full_vessel(g: Generator, scene: SystemScene, level: str) -> HiddenTerm:
    top, power = scene.largest(level), choose(g, (1.5, 2.5))
    form = flows.weir(scene.plant.row(level), uniform(g, 0.55, 0.85) * top, power)
    large = 5.0 * scene.pace(level) / (0.2 * top) ** power
    name = "rectangular weir" if power == 1.5 else "V-notch weir"
    return HiddenTerm("overflow", name, (rate_of(level),), large, form)


@drawn_for
def gravel_leak(g: Generator, scene: SystemScene, level: str) -> HiddenTerm:
    typical = scene.typical(level)
    form = flows.seepage(scene.plant.row(level), uniform(g, 0.0, 0.3) / typical)
    large = scene.pace(level) / typical
    return HiddenTerm("linear_drag", "Darcy and Forchheimer's leak", (rate_of(level),), large, form)


@drawn_for
def machine_nearby(g: Generator, scene: SystemScene, speed: str) -> HiddenTerm:
    form = forces.hum(scene.plant.row(speed), uniform(g, 5.0, 30.0) / scene.length)
    return HiddenTerm("vibration", "sinusoid of time", (rate_of(speed),), scene.pace(speed), form, own=2)


@dataclass(frozen=True)
class System:
    """A system: its draws, and the effects that can be hidden in it.

    Attributes:
        draw: draws the plant, its runs, and the runs of the second recording.
        trial: draws runs of the plant.
        inside, outside: effects of the catalogue, and others.
    """

    draw: Callable[[Generator], Setting]
    trial: Trial
    inside: Sequence[Draw]
    outside: Sequence[Draw]
