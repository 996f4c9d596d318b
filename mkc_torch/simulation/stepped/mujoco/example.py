"""A recording simulated by a model of MuJoCo, with the columns that a recording of it needs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mkc_torch.simulation.names import Names
from mkc_torch.simulation.stepped.mujoco.description import MjcfError
from mkc_torch.simulation.stepped.mujoco.stepper import load_mjcf

_SECONDS = 20.0
_SAMPLE = 0.02
"""Time between samples in s, that of many robots."""

_SHARE = 0.3
"""Amplitude of each control, as a share of its range; of 1 where it has none."""


def example_recording(path: str | Path) -> dict[str, Tensor]:
    """Return the columns of 20 s at 50 Hz in which each control follows two sines, and each joint's position.

    Args:
        path: of the MJCF or URDF file.

    Raises:
        MjcfError: the model cannot be used, has no actuator, or diverges.
        ImportError: MuJoCo is not installed.
    """
    simulation = load_mjcf(path)
    found = simulation.description
    if not found.inputs:
        raise MjcfError(
            f"{path}: the model has no actuator, and nothing drives it. A recording needs the columns time and "
            f"{', '.join(found.positions)}; give its motors as <actuator>, or record a motion that starts moved."
        )
    steps = max(round(_SAMPLE / found.time_step), 1)
    time = steps * found.time_step * np.arange(round(_SECONDS / (steps * found.time_step)))
    model = found.model
    columns = []
    for k in range(model.nu):
        low, high = model.actuator_ctrlrange[k] if model.actuator_ctrllimited[k] else (-1.0, 1.0)
        rates = 2.0 * np.pi * np.array([0.11 + 0.02 * k, 0.37 + 0.03 * k])
        course = (np.sin(np.outer(time, rates)) * [0.7, 0.3]).sum(1)
        columns.append(0.5 * (low + high) + _SHARE * 0.5 * (high - low) * course)
    controls = np.stack(columns, 1)
    held = controls.repeat(steps, 0)
    p = Names(**{name: number.value for name, number in found.numbers.items()})
    start = np.array([found.initial[name] for name in found.states])
    states = simulation.rollout(start, held, np.zeros((len(held), len(found.forces))), p, found.time_step)
    if not np.isfinite(states).all():
        raise MjcfError(f"{path}: the simulation diverges with these controls; give its actuators a ctrlrange.")
    at_samples = np.concatenate([start[None], states])[:-1:steps]
    joints = zip(found.positions, at_samples.T, strict=False)
    driven = zip(found.inputs, controls.T, strict=True)
    return {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in [("time", time), *driven, *joints]}
