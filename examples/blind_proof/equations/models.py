"""Simulations as a user would write them: the nominal ones, and in ``...Other`` other systems with the same columns.

The diagnosis gets a copy of one class at a time.
"""

# ruff: noqa: ARG002, RUF012 - plain class attributes, and a derivative with unused arguments

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from mkc_torch.simulation import Dynamics, Parameter, Static


class Pendulum(Dynamics):
    states = ("angle", "speed")
    inputs = ("torque",)
    outputs = ("angle",)
    units = {"angle": "rad", "speed": "rad/s", "torque": "N m"}
    parameters = {"stiffness": Parameter(9.0, lower=0.0), "damping": Parameter(0.2, lower=0.0), "gain": 1.0}

    def derivative(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor]:
        return {
            "angle": x.speed,
            "speed": p.gain * u.torque - p.stiffness * torch.sin(x.angle) - p.damping * x.speed,
        }


class CartPole(Dynamics):
    states = ("position", "speed", "angle", "turn")
    inputs = ("force",)
    outputs = ("position", "angle")
    units = {"position": "m", "speed": "m/s", "angle": "rad", "turn": "rad/s", "force": "N"}
    parameters = {
        "gain": 0.5,
        "drag": Parameter(0.5, lower=0.0),
        "length": Parameter(1.0, lower=0.1),
        "damping": Parameter(0.2, lower=0.0),
    }

    def derivative(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor]:
        drive = p.gain * u.force - p.drag * x.speed
        swing = -(drive * torch.cos(x.angle) + 9.81 * torch.sin(x.angle)) / p.length - p.damping * x.turn
        return {"position": x.speed, "speed": drive, "angle": x.turn, "turn": swing}


class Tanks(Dynamics):
    states = ("level_1", "level_2")
    inputs = ("pump_1", "pump_2")
    units = {"level_1": "m", "level_2": "m", "pump_1": "V", "pump_2": "V"}
    parameters = {
        "gain_1": 0.0015,
        "gain_2": 0.0015,
        "outlet_1": Parameter(0.012, lower=0.0),
        "outlet_2": Parameter(0.012, lower=0.0),
    }

    def derivative(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor]:
        return {
            "level_1": p.gain_1 * u.pump_1 - p.outlet_1 * torch.sqrt(x.level_1.clamp(min=1e-4)),
            "level_2": p.gain_2 * u.pump_2 - p.outlet_2 * torch.sqrt(x.level_2.clamp(min=1e-4)),
        }


class Motor(Dynamics):
    states = ("angle", "speed", "current")
    inputs = ("voltage",)
    outputs = ("angle", "current")
    units = {"angle": "rad", "speed": "rad/s", "current": "A", "voltage": "V"}
    parameters = {
        "torque": 12.0,
        "damping": Parameter(0.6, lower=0.0),
        "drive": 7.0,
        "resistance": Parameter(12.0, lower=0.0),
        "back_emf": 0.6,
    }

    def derivative(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor]:
        return {
            "angle": x.speed,
            "speed": p.torque * x.current - p.damping * x.speed,
            "current": p.drive * u.voltage - p.resistance * x.current - p.back_emf * x.speed,
        }


class Projectile(Dynamics):
    states = ("distance", "height", "speed", "climb")
    outputs = ("distance", "height")
    units = {"distance": "m", "height": "m", "speed": "m/s", "climb": "m/s"}

    def derivative(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor]:
        return {
            "distance": x.speed,
            "height": x.climb,
            "speed": torch.zeros_like(x.speed),
            "climb": torch.full_like(x.climb, -9.81),
        }


class Thermal(Dynamics):
    states = ("temperature_1", "temperature_2")
    inputs = ("heater_1", "heater_2")
    units = {"temperature_1": "°C", "temperature_2": "°C", "heater_1": "W", "heater_2": "W"}
    parameters = {
        "loss_1": Parameter(0.0045, lower=0.0),
        "loss_2": Parameter(0.0045, lower=0.0),
        "gain_1": 0.009,
        "gain_2": 0.009,
        "room": Parameter(20.0, unit="°C"),
    }

    def derivative(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor]:
        return {
            "temperature_1": p.gain_1 * u.heater_1 - p.loss_1 * (x.temperature_1 - p.room),
            "temperature_2": p.gain_2 * u.heater_2 - p.loss_2 * (x.temperature_2 - p.room),
        }


class Servo(Static):
    inputs = ("command",)
    outputs = ("angle",)
    units = {"command": "rad", "angle": "rad"}
    parameters = {"scale": 1.0}

    def output(self, time: Tensor, u: Any, p: Any) -> Mapping[str, Tensor]:
        return {"angle": p.scale * u.command}


class PendulumOther(Dynamics):
    states = ("angle",)
    inputs = ("torque",)
    units = {"angle": "rad", "torque": "N m"}
    parameters = {"gain": 1.0, "decay": Parameter(1.0, lower=0.0)}

    def derivative(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor]:
        return {"angle": p.gain * u.torque - p.decay * x.angle}


class CartPoleOther(Dynamics):
    states = ("position", "angle")
    inputs = ("force",)
    units = {"position": "m", "angle": "rad", "force": "N"}
    parameters = {
        "gain_1": 0.5,
        "gain_2": 0.5,
        "decay_1": Parameter(1.0, lower=0.0),
        "decay_2": Parameter(1.0, lower=0.0),
    }

    def derivative(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor]:
        return {
            "position": p.gain_1 * u.force - p.decay_1 * x.position,
            "angle": p.gain_2 * u.force - p.decay_2 * x.angle,
        }


class MotorOther(Dynamics):
    states = ("angle", "current")
    inputs = ("voltage",)
    units = {"angle": "rad", "current": "A", "voltage": "V"}
    parameters = {
        "gain_1": 1.0,
        "gain_2": 1.0,
        "decay_1": Parameter(8.0, lower=5.0),
        "decay_2": Parameter(8.0, lower=0.0),
    }

    def derivative(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor]:
        return {
            "angle": p.gain_1 * u.voltage - p.decay_1 * x.angle,
            "current": p.gain_2 * u.voltage - p.decay_2 * x.current,
        }


class ProjectileOther(Dynamics):
    states = ("distance", "height", "speed", "climb")
    outputs = ("distance", "height")
    units = {"distance": "m", "height": "m", "speed": "m/s", "climb": "m/s"}
    parameters = {"friction": Parameter(0.3, lower=0.0)}

    def derivative(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor]:
        return {
            "distance": x.speed,
            "height": x.climb,
            "speed": -p.friction * x.speed,
            "climb": -p.friction * x.climb,
        }
