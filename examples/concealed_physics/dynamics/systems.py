"""Four simulations of a few lines, with the recordings for diagnosis and for proof.

Data:
    falling balls: de Silva et al., "Discovery of Physics from Data: Universal Laws and Discrepancies", Frontiers in AI
        3:25 (2020).
    heaters: Hedengren, "Temperature Control Lab", github.com/APMonitor/arduino, Apache-2.0; its energy balance in
        github.com/APMonitor/pdc, Module_22.
    Silverbox: Wigren & Schoukens, "Three free data sets for development and benchmarking in nonlinear system
        identification", European Control Conference 2013.
    servo: Duclusaud et al., "Extended Friction Models for the Physics Simulation of Servo Actuators", ICRA 2025,
        arXiv:2410.08650, github.com/Rhoban/bam, Apache-2.0.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch

from mkc_torch import Recording
from mkc_torch.simulation import Dynamics, Parameter

EVERY = 8
"""Every how many samples of the servo, at 190 Hz, are used."""

SILVERBOX_TRAIN = (45_000, 8_192)
SILVERBOX_TESTS = {"multisine": (100_000, 8_192), "arrow": (0, 40_000)}
"""First row and number of rows."""


class Ball(Dynamics):
    """A ball in free fall."""

    states = ("height", "speed")
    units = {"height": "m", "speed": "m/s"}
    initial_window = 1.0

    def derivative(self, time, x, u, p):
        return {"height": x.speed, "speed": torch.full_like(x.speed, -9.81)}


class Heaters(Dynamics):
    """Each heater warms its own sensor, which cools to the room.

    The energy balance that is published with the board, m c Ṫ = U A (Tₐ − T) + α Q with Tₐ = 23 °C and one U for both,
    without what passes from one heater to the other and without radiation. U and both α are fitted, as they are there.
    """

    states = ("temperature_1", "temperature_2")
    inputs = ("heater_1", "heater_2")
    units = {"temperature_1": "°C", "temperature_2": "°C"}
    input_hold = "held"
    parameters = {
        "loss": Parameter(0.005, lower=0.0, unit="1/s"),
        "gain_1": Parameter(0.005, lower=0.0),
        "gain_2": Parameter(0.004, lower=0.0),
    }

    def derivative(self, time, x, u, p):
        return {
            "temperature_1": p.loss * (23.0 - x.temperature_1) + p.gain_1 * u.heater_1,
            "temperature_2": p.loss * (23.0 - x.temperature_2) + p.gain_2 * u.heater_2,
        }


class Silverbox(Dynamics):
    """A linear resonator, driven with an offset."""

    states = ("output", "speed")
    inputs = ("input",)
    input_hold = "smooth"
    initial_window = 0.1
    parameters = {
        "stiffness": Parameter(1.8e5, lower=0.0, unit="1/s²"),
        "damping": Parameter(20.0, lower=0.0, unit="1/s"),
        "gain": 1e5,
        "offset": 0.0,
    }

    def derivative(self, time, x, u, p):
        return {
            "output": x.speed,
            "speed": p.gain * (u.input + p.offset) - p.stiffness * x.output - p.damping * x.speed,
        }


class Servo(Dynamics):
    """A motor behind a proportional controller, which turns a pendulum; while it is driven, its own field brakes it.

    The supply counts as constant: its recorded voltage jumps between 6.2 and 8.2 V while the motor stands still under
    load (up_and_down_kp400 from 3.2 s on), and nothing moves by it.
    """

    states = ("position", "speed")
    inputs = ("goal_position", "kp", "torque_enable")
    outputs = ("position",)
    units = {"position": "rad", "speed": "rad/s"}
    initial_window = 0.1
    parameters = {
        "drive": Parameter(75.0, lower=0.0, unit="1/s²"),
        "back_emf": Parameter(3.0, lower=0.0, unit="1/s"),
        "damping": Parameter(3.0, lower=0.0, unit="1/s"),
        "gravity": Parameter(75.0, lower=0.0, unit="1/s²"),
        "gain": Parameter(0.005, lower=0.0),
    }

    def derivative(self, time, x, u, p):
        duty = torch.clamp(p.gain * u.kp * (u.goal_position - x.position), -1.0, 1.0) * u.torque_enable
        braking = (p.damping + p.back_emf * u.torque_enable) * x.speed
        pull = p.gravity * torch.sin(x.position)
        return {"position": x.speed, "speed": p.drive * duty - braking - pull}


@dataclass(frozen=True)
class Case:
    """A simulation, its training runs, and the unseen runs.

    Attributes:
        name: name of the system, or of one of several.
        system: the simulation.
        train: the runs to learn from.
        tests: the unseen ones, by name.
        scored_from: in s since a run's start; what comes before serves to estimate the first states.
    """

    name: str
    system: Dynamics
    train: Recording
    tests: Mapping[str, Recording]
    scored_from: float = -math.inf


def balls(data: Path) -> list[Case]:
    """Return the first and the second drop of every ball."""
    drops = {
        name: Recording({"time": drop["time"], "height": drop["height"]}, name=name.split("/")[0])
        for name, drop in Recording.read(data / "falling_balls" / "ball_drops.csv").experiments().items()
    }
    names = [name.removesuffix("/1") for name in drops if name.endswith("/1")]
    return [Case(b, Ball(), drops[f"{b}/1"], {"other drop": drops[f"{b}/2"]}, Ball.initial_window) for b in names]


def heaters(data: Path) -> Case:
    """Return one run for training and the other for proof."""
    train, test = (Recording.read(data / "heaters" / f"run_{rate}.csv") for rate in ("1s", "3s"))
    return Case("heaters", Heaters(), train, {"other run": test})


def silverbox(data: Path) -> Case:
    """A part of a multisine; a part of another one, and the arrow."""
    table = Recording.read(data / "silverbox" / "silverbox.csv")

    def rows(first: int, count: int) -> Recording:
        return Recording({name: table[name][first : first + count] for name in table.names})

    tests = {name: rows(*test) for name, test in SILVERBOX_TESTS.items()}
    return Case("Silverbox", Silverbox(), rows(*SILVERBOX_TRAIN), tests, Silverbox.initial_window)


def servo(data: Path) -> Case:
    """All runs at two gains of the controller, and at two others."""
    folder = data / "servo"
    return Case("servo", Servo(), servo_runs(folder, (100, 400)), {"other gains": servo_runs(folder, (200, 800))})


def servo_runs(folder: Path, gains: tuple[int, ...]) -> Recording:
    """All runs at these gains in one table.

    Raises:
        FileNotFoundError: the folder has no run at one of the gains.
    """
    columns: dict[str, list[torch.Tensor]] = {}
    files = [(path, gain) for gain in gains for path in sorted(folder.glob(f"*_kp{gain}.csv"))]
    missing = sorted(set(gains) - {gain for _, gain in files})
    if missing:
        raise FileNotFoundError(f"{folder / f'*_kp{missing[0]}.csv'}: there is no such file.")
    for number, (path, gain) in enumerate(files):
        run = Recording.read(path)
        part = {name: run[name][::EVERY] for name in ("time", "position", "goal_position", "torque_enable")}
        part["kp"] = torch.full_like(part["time"], float(gain))
        part["experiment"] = torch.full_like(part["time"], float(number))
        for name, values in part.items():
            columns.setdefault(name, []).append(values)
    return Recording({name: torch.cat(parts) for name, parts in columns.items()})
