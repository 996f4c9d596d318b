"""Fit the numbers of the arm alone, by the least squares of `mujoco.sysid` (``pip install "mujoco[sysid]"``)."""

from __future__ import annotations

from contextlib import redirect_stdout
from functools import partial
from io import StringIO
from typing import Any

import mujoco
import numpy as np
from mujoco import sysid

from examples.numbers_alone.recordings import ARM, JOINTS, MOTORS, NUMBERS, SAMPLE, Array


def _set_damping(spec: Any, parameter: Any, joint: str) -> None:
    known = spec.joint(joint).damping
    spec.joint(joint).damping = [parameter.value[0], *known[1:]] if hasattr(known, "__len__") else parameter.value[0]


def fitted_numbers(recording: dict[str, Array]) -> dict[str, float]:
    """The damping of both joints that is most likely where nothing else is missing."""
    spec = mujoco.MjSpec.from_string(ARM)
    model = spec.compile()
    time, angles = recording["time"], np.stack([recording[name] for name in JOINTS], 1)
    control = sysid.TimeSeries(*_held(recording, model.opt.timestep))
    measured = sysid.TimeSeries.from_names(time, angles, model)
    start = sysid.create_initial_state(model, angles[0], np.zeros(2), np.zeros(0))
    parameters = sysid.ParameterDict()
    for joint in JOINTS:
        name = f"{joint}_damping"
        parameters.add(
            sysid.Parameter(
                name, NUMBERS[name], min_value=0.0, max_value=5.0, modifier=partial(_set_damping, joint=joint)
            )
        )
    sequences = sysid.ModelSequences("arm", spec, "recording", start, control, measured)
    residual = sysid.build_residual_fn(models_sequences=[sequences])
    with redirect_stdout(StringIO()):  # it prints each iteration
        found, _ = sysid.optimize(initial_params=parameters, residual_fn=residual, verbose=False)
    return {name: float(found[name].value[0]) for name in NUMBERS}


def _held(recording: dict[str, Array], step: float) -> tuple[Array, Array]:
    """Times and torques of each step, held from sample to sample."""
    parts = round(SAMPLE / step)
    given = np.stack([recording[name] for name in MOTORS], 1).repeat(parts, 0)
    time: Array = step * np.arange(len(given), dtype=np.float64)
    return time, given
