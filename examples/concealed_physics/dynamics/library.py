"""Terms of the baselines' library: for each system those of its simulation and those of the catalogue."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import SimpleNamespace

import torch
from torch import Tensor

Terms = dict[str, Callable[[], Tensor]]
"""Functions of the terms by name; a function is called only if its term is used."""


@dataclass(frozen=True)
class Shape:
    """Parameters of the terms that are not linear in their parameters, in the states' units.

    ``width`` is that of the smoothed sign, ``stribeck`` the Stribeck speed, ``place`` the position of the stops.
    """

    width: float = 1.0
    stribeck: float = 1.0
    place: float = 1.0


@dataclass(frozen=True)
class Physics:
    """Knowledge of a system that the baselines get.

    Attributes:
        own: terms of the simulation in the rate of each state.
        more: further terms of the catalogue, by state.
        terms: function that returns all terms, given states, inputs, fitted parameters of the simulation and shape.
        drives: function that returns the driving terms of the inputs, for the neural ODE.
        parts: integration steps between two samples.
        windows: window lengths of multiple shooting to choose from, in steps.
        piece: length in steps of the pieces in which the held-out part is simulated, each from its own start; 0 for
            one free run from the start of the run.
        absolute: whether the error is the mean absolute error instead of the RMSE.
        unit: unit of reported errors.
        factor: number of these units in the unit of the recording.
        shapes: whether the library has terms with a shape.
    """

    own: Mapping[str, tuple[str, ...]]
    more: Mapping[str, tuple[str, ...]]
    terms: Callable[[SimpleNamespace, SimpleNamespace, SimpleNamespace, Shape], Terms]
    drives: Callable[[SimpleNamespace, SimpleNamespace, SimpleNamespace], tuple[Tensor, ...]]
    parts: int
    windows: tuple[int, ...]
    absolute: bool
    unit: str
    piece: int = 0
    factor: float = 1.0
    shapes: bool = False


def friction(v: Tensor, load: Callable[[], Tensor], shape: Shape) -> Terms:
    """Return terms of dry friction: constant, rising towards standstill, and in proportion to the load."""

    def sign() -> Tensor:
        return torch.tanh(v / shape.width)

    return {
        "sign(v)": sign,
        "sign(v) exp(-(v/s)^2)": lambda: sign() * torch.exp(-((v / shape.stribeck) ** 2)),
        "sign(v) |load|": lambda: sign() * load().abs(),
    }


def stops(x: Tensor, shape: Shape) -> Terms:
    """Return stiff springs beyond a position on either side."""
    return {
        "max(x - c, 0)": lambda: (x - shape.place).clamp(min=0.0),
        "max(-c - x, 0)": lambda: (-shape.place - x).clamp(min=0.0),
    }


def ball_terms(x: SimpleNamespace, _u: SimpleNamespace, _p: SimpleNamespace, _shape: Shape) -> Terms:
    """Return the terms for a body in the air."""
    v = x.speed
    return {"1": lambda: torch.ones_like(v), "v": lambda: v, "v|v|": lambda: v * v.abs()}


def heater_terms(x: SimpleNamespace, u: SimpleNamespace, _p: SimpleNamespace, _shape: Shape) -> Terms:
    """Return the terms for two heated bodies that exchange heat and radiate."""
    first, second = x.temperature_1, x.temperature_2
    return {
        "1": lambda: torch.ones_like(first),
        "T1": lambda: first,
        "T2": lambda: second,
        "Q1": lambda: u.heater_1.expand_as(first),
        "Q2": lambda: u.heater_2.expand_as(first),
        "T2 - T1": lambda: second - first,
        "T1 - T2": lambda: first - second,
        "T1^4": lambda: ((first + 273.15) / 293.15) ** 4,
        "T2^4": lambda: ((second + 273.15) / 293.15) ** 4,
        "T1|T1|": lambda: first * first.abs(),
        "T2|T2|": lambda: second * second.abs(),
    }


def silverbox_terms(x: SimpleNamespace, u: SimpleNamespace, p: SimpleNamespace, shape: Shape) -> Terms:
    """Return the terms for a driven oscillator."""
    y, v = x.output, x.speed

    def load() -> Tensor:
        return p.gain * (u.input + p.offset) - p.stiffness * y

    known: Terms = {
        "1": lambda: torch.ones_like(v),
        "x": lambda: y,
        "v": lambda: v,
        "u": lambda: u.input.expand_as(v),
        "x^3": lambda: y**3,
        "v|v|": lambda: v * v.abs(),
    }
    return known | friction(v, load, shape) | stops(y, shape)


def servo_terms(x: SimpleNamespace, u: SimpleNamespace, p: SimpleNamespace, shape: Shape) -> Terms:
    """Return the terms for a motor with a pendulum."""
    angle, v = x.position, x.speed

    def load() -> Tensor:
        return p.drive * servo_drive(x, u, p) - p.gravity * angle.sin()

    known: Terms = {
        "V duty": lambda: servo_drive(x, u, p),
        "v": lambda: v,
        "sin x": lambda: angle.sin(),
        "1": lambda: torch.ones_like(v),
        "x^3": lambda: angle**3,
        "v|v|": lambda: v * v.abs(),
        "cos x": lambda: angle.cos(),
        "sin 2x": lambda: (2 * angle).sin(),
        "cos 2x": lambda: (2 * angle).cos(),
    }
    return known | friction(v, load, shape) | stops(angle, shape)


def servo_drive(x: SimpleNamespace, u: SimpleNamespace, p: SimpleNamespace) -> Tensor:
    """Return the motor's duty cycle, by the control law that the simulation assumes."""
    return u.torque_enable * torch.clamp(p.gain * u.kp * (u.goal_position - x.position), -1.0, 1.0)


FRICTION = ("sign(v)", "sign(v) exp(-(v/s)^2)", "sign(v) |load|")
STOPS = ("max(x - c, 0)", "max(-c - x, 0)")
PHYSICS = {
    "Ball": Physics(
        own={"speed": ()},
        more={"speed": ("1", "v", "v|v|")},
        terms=ball_terms,
        drives=lambda *_: (),
        parts=1,
        windows=(8, 16),
        absolute=True,
        unit="m",
    ),
    "Heaters": Physics(
        own={"temperature_1": ("1", "T1", "Q1"), "temperature_2": ("1", "T2", "Q2")},
        more={"temperature_1": ("T2 - T1", "T1^4", "T1|T1|"), "temperature_2": ("T1 - T2", "T2^4", "T2|T2|")},
        terms=heater_terms,
        drives=lambda _x, u, _p: (u.heater_1, u.heater_2),
        parts=1,
        windows=(15, 45),
        absolute=False,
        unit="°C",
    ),
    "Silverbox": Physics(
        own={"speed": ("1", "x", "v", "u")},
        more={"speed": ("x^3", "v|v|", *FRICTION, *STOPS)},
        terms=silverbox_terms,
        drives=lambda _x, u, _p: (u.input,),
        parts=2,
        windows=(8, 24),
        absolute=False,
        unit="mV",
        piece=614,
        factor=1e3,
        shapes=True,
    ),
    "Servo": Physics(
        own={"speed": ("V duty", "v", "sin x")},
        more={"speed": ("1", "x^3", "v|v|", "cos x", "sin 2x", "cos 2x", *FRICTION, *STOPS)},
        terms=servo_terms,
        drives=lambda x, u, p: (servo_drive(x, u, p),),
        parts=2,
        windows=(8, 24),
        absolute=True,
        unit="rad",
        shapes=True,
    ),
}
