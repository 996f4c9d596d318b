"""The columns of a recording other than the magnetometer's: drivers, motion, decoys."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Generator, Tensor

from examples.blind_proof.draws import choose, happens, log_uniform, normal, smooth, uniform, whole
from examples.blind_proof.magnetometer import rotation
from examples.blind_proof.magnetometer.noise import Noise
from examples.blind_proof.magnetometer.scene import (
    Scene,
    lagged,
    recorded_current,
    recorded_temperature,
    recorded_voltage,
)

if TYPE_CHECKING:
    from jaxtyping import Float


MODES = ("norm", "gyro", "attitude")
MODE_SHARES = (0.60, 0.15, 0.25)
PRESENT: Mapping[str, float] = {"temperature": 0.6, "current": 0.5, "position": 0.4, "voltage": 0.3, "accel": 0.2}
"""Shares of the recordings with an unneeded column, by column."""

_DECIMALS: Mapping[str, int] = {"mag": 4, "gyro": 5, "accel": 4, "position": 4, "temperature": 4, "q": 6}


@dataclass(frozen=True)
class Plan:
    """The columns of both recordings of a case; ``copied`` is the driver that decoys may resemble."""

    mode: str
    present: frozenset[str]
    copied: str
    decoys: Mapping[str, Decoy]


def draw_plan(g: Generator, needed: frozenset[str], withheld: frozenset[str]) -> Plan:
    """Draw the columns: the needed columns, no withheld column, and others at random."""
    mode = choose(g, MODES, MODE_SHARES)
    lucky = frozenset(name for name, share in PRESENT.items() if happens(g, share))
    driver = next(iter(sorted(needed | withheld)), "")
    decoys = draw_decoys(g, copies=driver != "")
    named = {f"aux_{k}": decoy for k, decoy in enumerate(decoys, start=1)}
    return Plan(mode, (lucky | needed) - withheld, driver, named)


def draw_columns(g: Generator, plan: Plan, scene: Scene, noise: Noise) -> dict[str, Float[Tensor, " N"]]:
    """Return the columns without time and magnetometer.

    The attitude has errors, which enter the residual.
    """
    columns: dict[str, Tensor] = {}
    count = len(scene.time)
    if plan.mode == "gyro":
        bias = uniform(g, 0.0, 0.01) * normal(g, 3)
        columns |= _vector("gyro", scene.motion.gyro + bias + 0.005 * normal(g, count, 3))
    if plan.mode == "attitude":
        columns |= dict(zip(("q_w", "q_x", "q_y", "q_z"), _recorded_attitude(g, scene, noise).unbind(-1), strict=True))
    if "accel" in plan.present:
        columns |= _vector("accel", scene.motion.accel + 0.05 * normal(g, count, 3))
    if "position" in plan.present:
        columns |= _vector("position", scene.motion.position + 0.005 * normal(g, count, 3))
    if "temperature" in plan.present:
        columns["temperature"] = recorded_temperature(g, scene.temperature)
    if "current" in plan.present:
        columns["current"] = recorded_current(g, scene.current)
    if "voltage" in plan.present:
        columns["voltage"] = recorded_voltage(g, scene.current)
    driver = _driver(plan.copied, scene)
    columns |= {name: decoy_column(g, decoy, scene.time, driver) for name, decoy in plan.decoys.items()}
    return rounded(columns)


def rounded(columns: Mapping[str, Float[Tensor, " N"]]) -> dict[str, Float[Tensor, " N"]]:
    """Round the columns as a logger prints them."""
    return {name: values.round(decimals=_DECIMALS.get(name.split("_")[0], 4)) for name, values in columns.items()}


def _driver(name: str, scene: Scene) -> Tensor | None:
    drivers = {"temperature": scene.temperature, "current": scene.current, "position": scene.motion.position[:, 0]}
    return drivers.get(name)


def _vector(name: str, values: Float[Tensor, "N 3"]) -> dict[str, Tensor]:
    return {f"{name}_{axis}": column for axis, column in zip("xyz", values.unbind(-1), strict=True)}


def _recorded_attitude(g: Generator, scene: Scene, noise: Noise) -> Float[Tensor, "N 4"]:
    """Return the attitude with a random error about each world axis, and a constant error."""
    if noise.attitude is None:
        return scene.motion.attitude
    errors = torch.stack([noise.attitude.sample(g, len(scene.time)) for _ in range(3)], -1)
    constant = math.radians(uniform(g, 0.0, 1.0)) * normal(g, 3)
    return rotation.product(rotation.from_vector(errors + constant), scene.motion.attitude)


COPY_SHARE = 0.5
"""Share of the recordings with a recordable driver in which one column or two resemble it."""

COPIES = ("correlated 0.5", "correlated 0.9", "correlated 0.99", "noisy", "lagged")
COPY_SHARES = (0.3, 0.3, 0.1, 0.15, 0.15)


@dataclass(frozen=True)
class Decoy:
    """The kind of a column, and its unit."""

    kind: str
    scale: float
    shift: float


def draw_decoys(g: Generator, *, copies: bool) -> list[Decoy]:
    """Draw one to five decoys; with ``copies`` some may resemble the driver."""
    kinds = [choose(g, ("trend", "walk", "wave")) for _ in range(whole(g, 1, 3))]
    if copies and happens(g, COPY_SHARE):
        kinds += [choose(g, COPIES, COPY_SHARES) for _ in range(whole(g, 1, 2))]
    order = torch.randperm(len(kinds), generator=g).tolist()
    return [Decoy(kinds[k], log_uniform(g, 0.1, 100.0), 10.0 * float(normal(g, 1))) for k in order]


def decoy_column(
    g: Generator, decoy: Decoy, time: Float[Tensor, " N"], driver: Float[Tensor, " N"] | None
) -> Float[Tensor, " N"]:
    """Return the column in its unit."""
    if decoy.kind in COPIES and driver is not None:
        values = copy(g, decoy.kind, time, driver)
    else:
        values = plain(g, decoy.kind, time)
    return decoy.scale * values + decoy.shift


def plain(g: Generator, kind: str, time: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Draw an unrelated column of size about 1."""
    count, step = len(time), float(time[1] - time[0])
    if kind == "trend":
        way = choose(g, (-1.0, 1.0))
        return way * torch.linspace(0.0, 3.0, count, dtype=torch.float64) + uniform(g, 0.02, 0.5) * normal(g, count)
    if kind == "walk":
        return normal(g, count).cumsum(0) / math.sqrt(count) * 3.0
    return smooth(g, count, 1, step, log_uniform(g, 0.5, 30.0))[:, 0] + 0.05 * normal(g, count)


def copy(g: Generator, kind: str, time: Float[Tensor, " N"], driver: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Draw a column that resembles the driver: correlated, with white noise, or delayed."""
    count, step = len(time), float(time[1] - time[0])
    x = (driver - driver.mean()) / driver.std().clamp(min=1e-12)
    if kind == "noisy":
        return x + uniform(g, 0.1, 1.0) * normal(g, count)
    if kind == "lagged":
        return lagged(x, step, log_uniform(g, 0.5, 10.0)) + 0.01 * normal(g, count)
    wanted = float(kind.split()[1])
    other = smooth(g, count, 1, step, uniform(g, 5.0, 25.0))[:, 0]
    other = other - other.mean() - (other * x).mean() * x
    return wanted * x + math.sqrt(1.0 - wanted**2) * other / other.std()
