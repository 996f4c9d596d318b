"""The wrong simulations in the generator's own code, to check that they are unusable."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from mkc_torch.challenge.dynamics.plant import Array, Plant
from mkc_torch.challenge.dynamics.scenarios.follows import Guess

WRONG_SIGN, OTHER, UNRELATED = "wrong sign", "another system", "unrelated output"

_FLOOR = 1e-4
_FREE = (-np.inf, np.inf)
_POSITIVE = (0.0, np.inf)


def _wrong_pendulum(x: Array, u: Array, p: Array) -> Array:
    return np.array([x[1], p[2] * u[0] + p[0] * np.sin(x[0]) - p[1] * x[1]])


def _lag(x: Array, u: Array, p: Array) -> Array:
    return np.array([p[0] * u[0] - p[1] * x[0]])


def _two_lags(x: Array, u: Array, p: Array) -> Array:
    return np.array([p[0] * u[0] - p[2] * x[0], p[1] * u[0] - p[3] * x[1]])


def _wrong_cart_pole(x: Array, u: Array, p: Array) -> Array:
    drive = p[0] * u[0] - p[1] * x[1]
    swing = -(drive * np.cos(x[2]) - 9.81 * np.sin(x[2])) / p[2] - p[3] * x[3]
    return np.array([x[1], drive, x[3], swing])


def _wrong_tanks(x: Array, u: Array, p: Array) -> Array:
    out = np.sqrt(np.maximum(x, _FLOOR))
    return np.array([p[0] * u[0] + p[2] * out[0], p[1] * u[1] + p[3] * out[1]])


def _crossed_tanks(x: Array, u: Array, p: Array) -> Array:
    out = np.sqrt(np.maximum(x, _FLOOR))
    return np.array([p[0] * u[1] - p[2] * out[0], p[1] * u[0] - p[3] * out[1]])


def _wrong_motor(x: Array, u: Array, p: Array) -> Array:
    return np.array([x[1], p[0] * x[2] - p[1] * x[1], p[2] * u[0] + p[3] * x[2] - p[4] * x[1]])


def _wrong_throw(x: Array, u: Array, p: Array) -> Array:  # noqa: ARG001
    return np.array([x[2], x[3], np.zeros_like(x[2]), np.full_like(x[3], 9.81)])


def _puck(x: Array, u: Array, p: Array) -> Array:  # noqa: ARG001
    return np.array([x[2], x[3], -p[0] * x[2], -p[0] * x[3]])


def _wrong_thermal(x: Array, u: Array, p: Array) -> Array:
    return np.array([p[2] * u[0] + p[0] * (x[0] - p[4]), p[3] * u[1] + p[1] * (x[1] - p[4])])


def _crossed_thermal(x: Array, u: Array, p: Array) -> Array:
    return np.array([p[2] * u[1] - p[0] * (x[0] - p[4]), p[3] * u[0] - p[1] * (x[1] - p[4])])


_STARTS: Mapping[str, tuple[tuple[float, ...], tuple[tuple[float, float], ...]]] = MappingProxyType(
    {
        "pendulum": ((9.0, 0.2, 1.0), (_POSITIVE, _POSITIVE, _FREE)),
        "cart_pole": ((0.5, 0.5, 1.0, 0.2), (_FREE, _POSITIVE, (0.1, np.inf), _POSITIVE)),
        "tanks": ((0.0015, 0.0015, 0.012, 0.012), (_FREE, _FREE, _POSITIVE, _POSITIVE)),
        "motor": ((12.0, 0.6, 7.0, 12.0, 0.6), (_FREE, _POSITIVE, _FREE, _POSITIVE, _FREE)),
        "projectile": ((), ()),
        "thermal": ((0.0045, 0.0045, 0.009, 0.009, 20.0), (_POSITIVE, _POSITIVE, _FREE, _FREE, _FREE)),
    }
)
"""Starting values and bounds of the nominal simulations."""

_FLOWS = (_POSITIVE,) * 4
_HEATS = (*(((0.001, np.inf),) * 2), _POSITIVE, _POSITIVE, (-50.0, 50.0))


def right(plant: Plant) -> Guess:
    """Return the nominal simulation."""
    return Guess(plant, *_STARTS[plant.name])


def wrong(plant: Plant, kind: str) -> Guess:
    """Return a simulation with a wrong sign, or of another system, with the columns of the recording."""
    starts, bounds = _STARTS[plant.name]
    if kind == WRONG_SIGN:
        rate = {
            "pendulum": _wrong_pendulum,
            "cart_pole": _wrong_cart_pole,
            "tanks": _wrong_tanks,
            "motor": _wrong_motor,
            "projectile": _wrong_throw,
            "thermal": _wrong_thermal,
        }[plant.name]
        changed = {
            "cart_pole": (_FREE, _POSITIVE, (0.1, 5.0), _POSITIVE),
            "tanks": _FLOWS,
            "thermal": _HEATS,
        }
        return Guess(replace(plant, rate=rate), starts, changed.get(plant.name, bounds))
    if plant.name == "pendulum":
        return Guess(replace(plant, states=("angle",), rate=_lag), (1.0, 1.0), (_FREE, _POSITIVE))
    if plant.name in ("cart_pole", "motor"):
        lags = replace(plant, states=plant.outputs, rate=_two_lags)
        if plant.name == "motor":
            return Guess(lags, (1.0, 1.0, 8.0, 8.0), (_FREE, _FREE, (5.0, np.inf), _POSITIVE))
        return Guess(lags, (0.5, 0.5, 1.0, 1.0), (_FREE, _FREE, _POSITIVE, _POSITIVE))
    if plant.name == "tanks":
        return Guess(replace(plant, rate=_crossed_tanks), starts, _FLOWS)
    if plant.name == "thermal":
        crossed = (_POSITIVE, _POSITIVE, _POSITIVE, _POSITIVE, _FREE)
        return Guess(replace(plant, rate=_crossed_thermal), starts, crossed)
    return Guess(replace(plant, rate=_puck), (0.3,), (_POSITIVE,))
