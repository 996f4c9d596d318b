"""Empty recordings of one simple system under each kind of noise: nothing is missing in the simulation of any."""

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

SAMPLES, STEP = 200, 0.05
FINE = 8
"""Steps of the integration between two samples."""

NOISE = 0.01
"""m, of the sensor."""

SLOW_SIZE, SLOW_SHARE = 0.02, 0.05
"""m, and share of the recording that the sensor's slow error lasts."""

AR = 0.6
"""Correlation of the autoregressive sensor from sample to sample."""

PUSH, LASTING_PUSH, LASTING_SHARE = 0.5, 0.3, 0.6
"""m/s² of a push that is new at each sample, and of one that lasts; the share of the recording for which it does."""


class Spring(Dynamics):
    """A mass on a spring with a damper, of which the place alone is measured."""

    states = ("place", "speed")
    inputs = ("force",)
    outputs = ("place",)
    units = MappingProxyType({"place": "m", "speed": "m/s", "force": "N"})
    parameters = MappingProxyType(
        {"stiffness": Parameter(3.0, lower=0.0), "damping": Parameter(0.4, lower=0.0), "gain": 0.8}
    )

    def derivative(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor]:  # noqa: ARG002
        return {"place": x.speed, "speed": p.gain * u.force - p.stiffness * x.place - p.damping * x.speed}


def recording(kind: str, seed: int) -> Recording:
    """An empty recording of a kind of :data:`KINDS`; the same seed gives the same one."""
    sensor, push, held = KINDS[kind]
    random = np.random.default_rng([seed, list(KINDS).index(kind)])
    time = STEP * np.arange(SAMPLES)
    force = sum(
        random.normal() * np.sin(w * time + random.uniform(0.0, 2.0 * np.pi)) for w in (0.4, 0.9, 1.7, 2.9, 6.0)
    )
    place = _moved(force, push(random), held, random.normal(0.0, 0.5, 2))
    columns = {"time": time, "force": force, "place": place + sensor(random)}
    return Recording({name: torch.from_numpy(one) for name, one in columns.items()}, name=kind)


def _moved(force: Array, push: Array, held: bool, begin: Array) -> Array:
    """The place at the samples, by the midpoint rule, exact to far below the noise."""
    h, found, x = STEP / FINE, [], begin
    for k in range(SAMPLES):
        found.append(x[0])
        rest = 0.0 if held or k == SAMPLES - 1 else force[k + 1] - force[k]
        for part in range(FINE):
            acting = force[k] + rest * (part + 0.5) / FINE + push[k]
            middle = x + 0.5 * h * _rate(x, acting)
            x = x + h * _rate(middle, acting)
    return np.array(found)


def _rate(x: Array, acting: float) -> Array:
    return np.array([x[1], acting - 4.0 * x[0] - 0.5 * x[1]])


def _white(random: np.random.Generator) -> Array:
    return NOISE * random.standard_normal(SAMPLES)


def _forgetting(random: np.random.Generator, kept: float) -> Array:
    """A stationary course of variance 1 that keeps so much of itself from sample to sample."""
    course = random.standard_normal(SAMPLES)
    course[1:] *= np.sqrt(1.0 - kept**2)
    for k in range(1, SAMPLES):
        course[k] += kept * course[k - 1]
    return course


def _slow_beside_white(random: np.random.Generator) -> Array:
    return _white(random) + SLOW_SIZE * _forgetting(random, float(np.exp(-1.0 / (SLOW_SHARE * SAMPLES))))


def _autoregressive(random: np.random.Generator) -> Array:
    return NOISE * _forgetting(random, AR)


def _none(random: np.random.Generator) -> Array:  # noqa: ARG001 - one signature
    return np.zeros(SAMPLES)


def _anew(random: np.random.Generator) -> Array:
    return PUSH * random.standard_normal(SAMPLES)


def _lasting(random: np.random.Generator) -> Array:
    return LASTING_PUSH * _forgetting(random, float(np.exp(-1.0 / (LASTING_SHARE * SAMPLES))))


Draw = Callable[[np.random.Generator], Array]

KINDS: Mapping[str, tuple[Draw, Draw, bool]] = MappingProxyType(
    {
        "white": (_white, _none, False),
        "slow sensor error": (_slow_beside_white, _none, False),
        "autoregressive sensor": (_autoregressive, _none, False),
        "process noise, white": (_white, _anew, False),
        "process noise, lasting": (_white, _lasting, False),
        "held inputs": (_white, _none, True),
    }
)
"""What the sensor adds, what pushes the speed, and whether the force is held between samples."""
