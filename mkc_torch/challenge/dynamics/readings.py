"""Rival forms for a system without states: textbook forms of effects on its outputs and its input."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mkc_torch.challenge.dynamics.plant import Array
from mkc_torch.challenge.dynamics.rivals import SHIFTS, RivalModel, input_forms
from mkc_torch.challenge.dynamics.scene import SystemScene
from mkc_torch.challenge.dynamics.transducers import lagged_each, play, transport


def readings(scene: SystemScene) -> list[RivalModel]:
    """Return all forms at all outputs and inputs of a plant without states."""
    plant, step = scene.plant, scene.trial.step / scene.plant.fine
    assert plant.reads is not None
    inputs = scene.course.inputs
    outputs = plant.reads(inputs, plant.values)
    found = []
    for row, name in enumerate(plant.outputs):
        for effect, columns, positive in output_forms(outputs[[row]], step, scene.length):
            traces = np.zeros((len(outputs), *columns.shape))
            traces[row] = columns
            found.append(RivalModel(effect, (name,), None, traces[:, :: plant.fine], positive))
    for row, name in enumerate(plant.inputs):
        for effect, course in input_forms(inputs[[row]], step, scene.length):
            changed = inputs.copy()
            changed[row] += course
            traces = (plant.reads(changed, plant.values) - outputs)[..., None]
            found.append(RivalModel(effect, (f"input {name}",), None, traces[:, :: plant.fine], True))
    return found


def output_forms(y: Array, step: float, length: float) -> Iterator[tuple[str, Array, bool]]:
    """Yield the forms of an output (1, F, R): effect, added columns (F, R, q), and whether amplitudes are positive."""
    largest, (own,) = float(np.abs(y).max()), y
    yield "offset", np.ones_like(own)[..., None], False
    yield "gravity_sag", np.stack([np.cos(own), np.sin(own)], -1), False
    time = np.arange(len(own))[:, None] * step
    yield "clock_drift", ((time - time.mean()) * np.gradient(own, step, axis=0))[..., None], False
    for share in SHIFTS:
        yield "delay", (transport(y, step, share * length) - y)[0][..., None], True
    for behind in np.moveaxis(lagged_each(y, step, np.array(SHIFTS) * length), -1, 0):
        yield "sensor_lag", (behind - y)[0][..., None], True
    for share in (0.01, 0.02, 0.04, 0.08, 0.15, 0.3):
        yield "backlash", (play(y, share * largest) - y)[0][..., None], True
    for share in (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9):
        yield "output_saturation", (np.clip(y, -share * largest, share * largest) - y)[0][..., None], True
