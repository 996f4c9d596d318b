"""Rival forms for a system: textbook forms of missing physics, each linear in its amplitudes.

They are written independently of the catalogue, from the same textbooks, so that the oracle does not depend on it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from examples.blind_proof.equations.flows import swung
from examples.blind_proof.equations.hidden import rate_of
from examples.blind_proof.equations.integrate import SystemScene
from examples.blind_proof.equations.plant import Array
from examples.blind_proof.equations.transducers import lagged_each, play, transport

_REVERSED = 0.05
"""Smallest share of the time in each direction for a state that counts as reversing."""

SHIFTS = tuple(float(s) for s in np.geomspace(0.0007, 0.1, 24))
"""Delays and lags, as shares of a run."""

SUPERSETS = {
    "coulomb_friction": ("stribeck_friction", "load_dependent_friction", "power_law"),
    "linear_drag": ("power_law",),
    "quadratic_drag": ("power_law",),
    "cubic_stiffness": ("power_law",),
}
"""Effects that contain another effect. They are not its rivals, because they always fit it."""


@dataclass(frozen=True)
class RivalModel:
    """A form: columns added to the rates (n, F, R, q), or to the outputs (m, T, R, q), for amplitudes of 1.

    ``positive``: amplitudes below 0 are not physical.
    """

    effect: str
    at: tuple[str, ...]
    forcing: Array | None
    outputs: Array | None
    positive: bool


def rival_forms(scene: SystemScene, gains: Array) -> list[RivalModel]:
    """Return all forms at all ports.

    Args:
        scene: the forms are evaluated along its trajectory.
        gains: derivative of the rates by the inputs (n, k, F, R).
    """
    plant = scene.plant
    found: list[RivalModel] = []
    for row, state in enumerate(plant.states):
        if state in plant.speeds:
            continue
        for effect, columns, positive in rate_forms(scene, state):
            forcing = np.zeros((len(plant.states), *columns.shape))
            forcing[row] = columns
            found.append(RivalModel(effect, (rate_of(state),), forcing, None, positive))
    found += _exchanges(scene)
    for k, name in enumerate(plant.inputs):
        step = scene.trial.step / plant.fine
        for effect, course in input_forms(scene.course.inputs[[k]], step, scene.length):
            forcing = gains[:, k] * course
            found.append(RivalModel(effect, (f"input {name}",), forcing[..., None], None, True))
    found += _lags(scene)
    return found


def rate_forms(scene: SystemScene, state: str) -> Iterator[tuple[str, Array, bool]]:
    """Yield the forms on the rate of a state: effect, columns (F, R, q), and whether amplitudes are positive."""
    plant, v = scene.plant, scene.state(state)
    heat, step = plant.units[state] == "°C", scene.trial.step / plant.fine
    position = next((name for name, speed in plant.speeds.items() if speed == state), None)
    yield "constant_force", np.ones_like(v)[..., None], False
    yield "linear_drag", -v[..., None], True
    yield "quadratic_drag", -(v * np.abs(v))[..., None], True
    for column in powers((v - v.min()) / np.ptp(v) if heat else v / np.abs(v).max()):
        yield "power_law", column, True
    yield from _memories(v, step, scene.length, swings=not heat)
    if _reverses(v):
        yield from _frictions(v, scene.typical(state), _load(scene, state, position))
    if position is not None:
        yield from _position_forms(scene.state(position), plant.units[position], named_height=position == "height")
        rates = plant.rate(scene.course.states, scene.course.inputs, plant.values)
        yield "added_mass", -rates[plant.row(state)][..., None], True
        if _reverses(v):
            for share in (0.05, 0.1, 0.2, 0.4, 0.8):
                yield "bouc_wen_hysteresis", -wound_up(scene.state(position), share)[..., None], True
    elif heat:
        yield "thermal_loss", -(((v + 273.15) / 293.15) ** 4 - 1.0)[..., None] * 293.15 / 4.0, True
    else:
        for share in (0.45, 0.55, 0.65, 0.75, 0.85, 0.93):
            yield "overflow", -np.maximum(v - share * v.max(), 0.0)[..., None], True


EXPONENTS = (0.5, 1.25, 1.5, 1.75, 2.5, 3.0)
"""Powers of a power law, in addition to linear and quadratic drag."""


def powers(y: Array) -> Iterator[Array]:
    """Return restoring terms by powers of y (F, R), each with largest value 1: columns (F, R, 1)."""
    for exponent in EXPONENTS:
        yield -(np.sign(y) * np.abs(y) ** exponent)[..., None]


def _memories(v: Array, step: float, length: float, *, swings: bool) -> Iterator[tuple[str, Array, bool]]:
    """Yield a second store that follows a state, and a coupled oscillating mass."""
    constants = length * np.array([0.005, 0.015, 0.03, 0.05, 0.08, 0.15])
    for constant, behind in zip(constants, np.moveaxis(lagged_each(v[None], step, constants)[0], -1, 0), strict=True):
        yield "hidden_lag", ((behind - v) / constant)[..., None], True
    if swings:
        omegas = 2.0 * np.pi / (length * np.geomspace(0.01, 0.25, 20))
        for damping in (0.03, 0.1):
            for pull in np.moveaxis(swung(v, step, omegas, np.full_like(omegas, damping)), -1, 0):
                yield "hidden_mode", pull[..., None], True


def _load(scene: SystemScene, state: str, position: str | None) -> Array | None:
    """Return driving and holding force at standstill (F, R); None without inputs or a position."""
    plant, course = scene.plant, scene.course
    if position is None or not plant.inputs:
        return None
    row = plant.row(state)
    still = course.states.copy()
    still[row] = 0.0
    driven = plant.rate(still, course.inputs, plant.values)[row]
    held = plant.rate(still, np.zeros_like(course.inputs), plant.values)[row]
    return np.abs(driven - 2.0 * held)


def _frictions(v: Array, typical: float, load: Array | None) -> Iterator[tuple[str, Array, bool]]:
    for width in (0.3, 0.1, 0.03):
        dry = -np.tanh(v / (width * typical))
        yield "coulomb_friction", dry[..., None], True
        if load is not None:
            yield "load_dependent_friction", np.stack([dry, dry * load], -1), True
        for speed in (0.15, 0.4, 1.0):
            rise = np.exp(-((v / (speed * typical)) ** 2))
            yield "stribeck_friction", np.stack([dry, dry * rise], -1), True


def wound_up(x: Array, share: float) -> Array:
    """Return the Bouc-Wen deflection (F, R) along positions (F, R); it yields at a share of the largest."""
    limit = share * np.abs(x).max()
    z = np.zeros_like(x)
    for k in range(1, len(x)):
        way = x[k] - x[k - 1]
        z[k] = z[k - 1] + way * (1.0 - np.where(way * z[k - 1] > 0.0, np.abs(z[k - 1]) / limit, 0.0))
    return z


def _position_forms(x: Array, unit: str, *, named_height: bool) -> Iterator[tuple[str, Array, bool]]:
    if _reverses(x):
        yield "cubic_stiffness", -(x[..., None] ** 3), False
        for column in powers(x / np.abs(x).max()):
            yield "power_law", column, False
    for share in (0.45, 0.55, 0.65, 0.75, 0.85, 0.93):
        place = share * np.abs(x).max()
        yield "hard_stop", np.stack([-np.maximum(x - place, 0.0), np.maximum(-place - x, 0.0)], -1), True
    if named_height:
        for surface in (0.3, 0.6, 0.9):
            for draught in (0.1, 0.3, 1.0):
                dip = np.clip((surface - x / np.abs(x).max()) / draught, 0.0, 1.0)
                yield "buoyancy", dip[..., None], True
    if unit == "rad":
        for order in (1, 2, 3, 4, 6, 8, 12, 24):
            yield "position_periodic_force", np.stack([np.sin(order * x), np.cos(order * x)], -1), False


def input_forms(u: Array, step: float, length: float) -> Iterator[tuple[str, Array]]:
    """Yield the forms of an input (1, F, R): effect and added signal (F, R)."""
    largest = float(np.abs(u).max())
    for share in SHIFTS:
        yield "input_delay", (transport(u, step, share * length) - u)[0]
    for behind in np.moveaxis(lagged_each(u, step, np.array(SHIFTS) * length), -1, 0):
        yield "input_lag", (behind - u)[0]
    yield "input_square", (u * np.abs(u) / largest - u)[0]
    for share in (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9):
        yield "input_saturation", (np.clip(u, -share * largest, share * largest) - u)[0]
    for share in (0.03, 0.06, 0.1, 0.2, 0.3):
        yield "dead_zone", -np.clip(u, -share * largest, share * largest)[0]
        yield "backlash", (play(u, share * largest) - u)[0]


def _exchanges(scene: SystemScene) -> list[RivalModel]:
    plant, found = scene.plant, []
    free = [state for state in plant.states if state not in plant.speeds]
    for item, other in combinations(free, 2):
        if plant.units[item] != plant.units[other]:
            continue
        away = scene.state(other) - scene.state(item)
        forcing = np.zeros((len(plant.states), *away.shape, 2))
        forcing[plant.row(item), ..., 0] = away
        forcing[plant.row(other), ..., 1] = -away
        places = (rate_of(item), rate_of(other))
        found.append(RivalModel("coupling", places, forcing, None, True))
        if plant.units[item] == "m/s":
            turned = np.zeros((len(plant.states), *away.shape, 1))
            turned[plant.row(item), ..., 0] = -scene.state(other)
            turned[plant.row(other), ..., 0] = scene.state(item)
            found.append(RivalModel("magnus_lift", places, turned, None, False))
    return found


def _lags(scene: SystemScene) -> list[RivalModel]:
    plant, step = scene.plant, scene.trial.step / scene.plant.fine
    measured = scene.course.states[[plant.row(name) for name in plant.outputs]]
    found = []
    for late in np.moveaxis(lagged_each(measured, step, np.array(SHIFTS) * scene.length), -1, 0):
        behind = (late - measured)[:, :: plant.fine]
        traces = np.zeros((*behind.shape, len(behind)))
        for k, item in enumerate(behind):
            traces[k, ..., k] = item
        found.append(RivalModel("sensor_lag", plant.outputs, None, traces, True))
    return found


def _reverses(values: Array) -> bool:
    return min(float((values > 0).mean()), float((values < 0).mean())) > _REVERSED


def readings(scene: SystemScene) -> list[RivalModel]:
    """Return all forms at all outputs and inputs of a plant without states."""
    plant, step = scene.plant, scene.trial.step / scene.plant.fine
    assert plant.reads is not None
    inputs = scene.course.inputs
    outputs = plant.reads(inputs, plant.values)
    found = []
    for row, name in enumerate(plant.outputs):
        for effect, columns, positive in output_forms(outputs[[row]], step, scene.length):
            traces = np.zeros((len(outputs), *columns.shape))
            traces[row] = columns
            found.append(RivalModel(effect, (name,), None, traces[:, :: plant.fine], positive))
    for row, name in enumerate(plant.inputs):
        for effect, course in input_forms(inputs[[row]], step, scene.length):
            changed = inputs.copy()
            changed[row] += course
            traces = (plant.reads(changed, plant.values) - outputs)[..., None]
            found.append(RivalModel(effect, (f"input {name}",), None, traces[:, :: plant.fine], True))
    return found


def output_forms(y: Array, step: float, length: float) -> Iterator[tuple[str, Array, bool]]:
    """Yield the forms of an output (1, F, R): effect, added columns (F, R, q), and whether amplitudes are positive."""
    largest, (own,) = float(np.abs(y).max()), y
    yield "offset", np.ones_like(own)[..., None], False
    yield "gravity_sag", np.stack([np.cos(own), np.sin(own)], -1), False
    time = np.arange(len(own))[:, None] * step
    yield "clock_drift", ((time - time.mean()) * np.gradient(own, step, axis=0))[..., None], False
    for share in SHIFTS:
        yield "delay", (transport(y, step, share * length) - y)[0][..., None], True
    for behind in np.moveaxis(lagged_each(y, step, np.array(SHIFTS) * length), -1, 0):
        yield "sensor_lag", (behind - y)[0][..., None], True
    for share in (0.01, 0.02, 0.04, 0.08, 0.15, 0.3):
        yield "backlash", (play(y, share * largest) - y)[0][..., None], True
    for share in (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9):
        yield "output_saturation", (np.clip(y, -share * largest, share * largest) - y)[0][..., None], True
