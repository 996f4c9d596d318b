"""What a diagnosis could say instead: families of traces, each a few columns in the measurement's axes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.challenge.magnetometer.scene import Scene

if TYPE_CHECKING:
    from jaxtyping import Float

ONSET_GRID = 1.0
"""Seconds between the onsets that a step may have."""

TIME_CONSTANTS = (3.0, 10.0, 30.0, 100.0)
"""Of the exponential drifts, in s."""

POSITION = ("position_x", "position_y", "position_z")
ROLES: Mapping[str, str] = {"temperature": "temperature_offset", "current": "current_field"}
"""The offset's name for a column whose role is known; for others it is ``driver_offset``."""

_NO_DRIVER = ("time", "mag_x", "mag_y", "mag_z")


@dataclass(frozen=True)
class EffectFamily:
    """The traces an effect could have, up to linear coefficients; µT in the measurement's axes."""

    effect: str
    drivers: tuple[str, ...]
    traces: Float[Tensor, "N 3 p"]


def step_family(time: Float[Tensor, " N"], onset: float) -> EffectFamily:
    return EffectFamily("hard_iron_step", (), _offset((time > onset).double()))


def column_family(name: str, values: Float[Tensor, " N"]) -> EffectFamily:
    """An offset that follows a recorded column."""
    return EffectFamily(ROLES.get(name, "driver_offset"), (name,), _offset(values - values.mean()))


def drift_families(time: Float[Tensor, " N"]) -> Iterable[EffectFamily]:
    """Linear and exponential in time."""
    x = time - time[0]
    for shape in (x / x[-1], *(torch.exp(-x / constant) for constant in TIME_CONSTANTS)):
        yield EffectFamily("offset_drift", (), _offset(shape))


def cubic_family(scene: Scene, *, about_zero: bool = False) -> EffectFamily:
    """The cube of the field on each axis, or with ``about_zero`` of the field and the hard iron together."""
    core = scene.field @ scene.sensor.soft.mT
    return EffectFamily(
        "cubic_nonlinearity", (), torch.diag_embed((core + scene.sensor.hard if about_zero else core) ** 3)
    )


def gradient_family(scene: Scene, position: Float[Tensor, "N 3"], *, vector: bool) -> EffectFamily:
    """A field that is linear in position: its length alone (3), or free of curl and divergence (5)."""
    place = position - position.mean(0)
    if not vector:
        return EffectFamily("field_gradient", POSITION, scene.along[:, :, None] * place[:, None])
    traces = [scene.measured(place @ tensor) for tensor in traceless()]
    return EffectFamily("field_gradient", POSITION, torch.stack(traces, -1))


def traceless() -> Float[Tensor, "5 3 3"]:
    """A basis of the symmetric matrices without a trace."""
    basis = torch.zeros(5, 3, 3, dtype=torch.float64)
    for k, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
        basis[k, i, j] = basis[k, j, i] = 1.0
    basis[3] = torch.diag(torch.tensor([1.0, -1.0, 0.0], dtype=torch.float64))
    basis[4] = torch.diag(torch.tensor([1.0, 1.0, -2.0], dtype=torch.float64)) / math.sqrt(3.0)
    return basis


def families(scene: Scene, columns: Mapping[str, Float[Tensor, " N"]], *, vector: bool) -> list[EffectFamily]:
    """All that the recorded columns allow.

    Args:
        columns: the recording's.
        vector: the attitude is known, so that the whole vector counts and not its length alone.
    """
    time = scene.time
    found = [column_family(name, values) for name, values in columns.items() if name not in _NO_DRIVER]
    found += drift_families(time)
    onset = float(time[0]) + 2.0
    while onset < float(time[-1]) - 2.0:
        found.append(step_family(time, onset))
        onset += ONSET_GRID
    found += [cubic_family(scene), cubic_family(scene, about_zero=True)]
    if all(name in columns for name in POSITION):
        position = torch.stack([columns[name] for name in POSITION], -1)
        found.append(gradient_family(scene, position, vector=vector))
    return found


def _offset(shape: Float[Tensor, " N"]) -> Float[Tensor, "N 3 3"]:
    return shape[:, None, None] * torch.eye(3, dtype=torch.float64)
