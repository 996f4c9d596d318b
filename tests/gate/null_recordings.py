"""Empty recordings of a simple system with each kind of noise: the simulation is complete."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mkc_torch.recording.recording import Recording
from mkc_torch.simulation import Dynamics, Parameter

Array = NDArray[np.float64]

SAMPLES = 200

STEP = 0.05
"""Seconds from sample to sample."""

FINE = 8
"""Steps of the integration between two samples."""

NOISE = 0.01
"""Standard deviation of the sensor's white noise, m."""

SLOW_SIZE = 0.02
"""Standard deviation of the sensor's slow error, m."""

SLOW_SHARE = 0.05
"""Correlation time of the sensor's slow error, as a share of the recording."""

AR = 0.6
"""Correlation of the autoregressive sensor from sample to sample."""

WHITE_DISTURBANCE = 0.5
"""Standard deviation of white process noise, m/s²."""

LASTING_DISTURBANCE = 0.3
"""Standard deviation of slow process noise, m/s²."""

LASTING_SHARE = 0.6
"""Correlation time of slow process noise, as a share of the recording."""


class Spring(Dynamics):
    """A mass on a spring with a damper; its place alone is measured."""

    states = ("place", "speed")
    inputs = ("force",)
    outputs = ("place",)
    units = MappingProxyType({"place": "m", "speed": "m/s", "force": "N"})
    parameters = MappingProxyType(
        {"stiffness": Parameter(3.0, lower=0.0), "damping": Parameter(0.4, lower=0.0), "gain": 0.8}
    )

    def derivative(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor]:
        return {"place": x.speed, "speed": p.gain * u.force - p.stiffness * x.place - p.damping * x.speed}


def recording(kind: str, seed: int) -> Recording:
    """Draw an empty recording of a kind of :data:`KINDS`; the same seed gives the same recording."""
    sensor, disturbance, held = KINDS[kind]
    random = np.random.default_rng([seed, list(KINDS).index(kind)])
    time = STEP * np.arange(SAMPLES)
    force = sum(
        random.normal() * np.sin(w * time + random.uniform(0.0, 2.0 * np.pi)) for w in (0.4, 0.9, 1.7, 2.9, 6.0)
    )
    place = _simulated_place(force, disturbance(random), held, random.normal(0.0, 0.5, 2))
    columns = {"time": time, "force": force, "place": place + sensor(random)}
    return Recording({name: torch.from_numpy(values) for name, values in columns.items()}, name=kind)


def _simulated_place(force: Array, disturbance: Array, held: bool, begin: Array) -> Array:
    """The place at the samples, by the midpoint rule, with errors far below the noise."""
    h, found, x = STEP / FINE, [], begin
    for k in range(SAMPLES):
        found.append(x[0])
        rest = 0.0 if held or k == SAMPLES - 1 else force[k + 1] - force[k]
        for part in range(FINE):
            acting = force[k] + rest * (part + 0.5) / FINE + disturbance[k]
            middle = x + 0.5 * h * _rate(x, acting)
            x = x + h * _rate(middle, acting)
    return np.array(found)


def _rate(x: Array, acting: float) -> Array:
    return np.array([x[1], acting - 4.0 * x[0] - 0.5 * x[1]])


def _white(random: np.random.Generator) -> Array:
    return NOISE * random.standard_normal(SAMPLES)


def _autoregressive_series(random: np.random.Generator, correlation: float) -> Array:
    """A stationary autoregressive series of variance 1 and lag-one correlation ``correlation``."""
    series = random.standard_normal(SAMPLES)
    series[1:] *= np.sqrt(1.0 - correlation**2)
    for k in range(1, SAMPLES):
        series[k] += correlation * series[k - 1]
    return series


def _slow_and_white(random: np.random.Generator) -> Array:
    return _white(random) + SLOW_SIZE * _autoregressive_series(random, float(np.exp(-1.0 / (SLOW_SHARE * SAMPLES))))


def _autoregressive(random: np.random.Generator) -> Array:
    return NOISE * _autoregressive_series(random, AR)


def _none(random: np.random.Generator) -> Array:
    return np.zeros(SAMPLES)


def _white_disturbance(random: np.random.Generator) -> Array:
    return WHITE_DISTURBANCE * random.standard_normal(SAMPLES)


def _lasting_disturbance(random: np.random.Generator) -> Array:
    return LASTING_DISTURBANCE * _autoregressive_series(random, float(np.exp(-1.0 / (LASTING_SHARE * SAMPLES))))


Draw = Callable[[np.random.Generator], Array]

KINDS: Mapping[str, tuple[Draw, Draw, bool]] = MappingProxyType(
    {
        "white": (_white, _none, False),
        "slow sensor error": (_slow_and_white, _none, False),
        "autoregressive sensor": (_autoregressive, _none, False),
        "process noise, white": (_white, _white_disturbance, False),
        "process noise, lasting": (_white, _lasting_disturbance, False),
        "held inputs": (_white, _none, True),
    }
)
"""Sensor error, process noise of the speed, and whether the force is held between samples, by kind of noise."""
