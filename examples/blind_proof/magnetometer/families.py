"""Rival explanations: families of traces, each with a few columns in the measurement's axes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from examples.blind_proof.magnetometer.scene import Scene

if TYPE_CHECKING:
    from jaxtyping import Float

ONSET_GRID = 1.0
"""Spacing of the onsets of a step, s."""

TIME_CONSTANTS = (3.0, 10.0, 30.0, 100.0)
"""Time constants of the exponential drifts, s."""

POSITION = ("position_x", "position_y", "position_z")
ROLES: Mapping[str, str] = {"temperature": "temperature_offset", "current": "current_field"}
"""Name of the offset effect by the role of its column; other columns have ``driver_offset``."""

_NO_DRIVER = ("time", "mag_x", "mag_y", "mag_z")


@dataclass(frozen=True)
class EffectFamily:
    """Columns that span the traces of an effect; µT in the measurement's axes."""

    effect: str
    drivers: tuple[str, ...]
    traces: Float[Tensor, "N 3 p"]


def step_family(time: Float[Tensor, " N"], onset: float) -> EffectFamily:
    return EffectFamily("hard_iron_step", (), _offset((time > onset).double()))


def column_family(name: str, values: Float[Tensor, " N"]) -> EffectFamily:
    """Return an offset that follows a recorded column."""
    return EffectFamily(ROLES.get(name, "driver_offset"), (name,), _offset(values - values.mean()))


def drift_families(time: Float[Tensor, " N"]) -> Iterable[EffectFamily]:
    """Return drifts that are linear and exponential in time."""
    x = time - time[0]
    for shape in (x / x[-1], *(torch.exp(-x / constant) for constant in TIME_CONSTANTS)):
        yield EffectFamily("offset_drift", (), _offset(shape))


def cubic_family(scene: Scene, *, about_zero: bool = False) -> EffectFamily:
    """Return the cube of the field on each axis; with ``about_zero`` that of field plus hard iron."""
    core = scene.field @ scene.sensor.soft.mT
    return EffectFamily(
        "cubic_nonlinearity", (), torch.diag_embed((core + scene.sensor.hard if about_zero else core) ** 3)
    )


def gradient_family(scene: Scene, position: Float[Tensor, "N 3"], *, vector: bool) -> EffectFamily:
    """Return a field that is linear in position: of its length (3), or without curl and divergence (5)."""
    place = position - position.mean(0)
    if not vector:
        return EffectFamily("field_gradient", POSITION, scene.along[:, :, None] * place[:, None])
    traces = [scene.measured(place @ tensor) for tensor in traceless()]
    return EffectFamily("field_gradient", POSITION, torch.stack(traces, -1))


def traceless() -> Float[Tensor, "5 3 3"]:
    """Return a basis of the traceless symmetric matrices."""
    basis = torch.zeros(5, 3, 3, dtype=torch.float64)
    for k, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
        basis[k, i, j] = basis[k, j, i] = 1.0
    basis[3] = torch.diag(torch.tensor([1.0, -1.0, 0.0], dtype=torch.float64))
    basis[4] = torch.diag(torch.tensor([1.0, 1.0, -2.0], dtype=torch.float64)) / math.sqrt(3.0)
    return basis


def families(scene: Scene, columns: Mapping[str, Float[Tensor, " N"]], *, vector: bool) -> list[EffectFamily]:
    """Return all families that the recorded columns allow.

    Args:
        columns: columns of the recording.
        vector: whether the attitude is known, so that the vector is compared and not its length.
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
