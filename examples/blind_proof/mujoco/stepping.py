"""Recordings of a robot by MuJoCo's own steps, finer than those of the user's file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

from examples.blind_proof.mujoco.elements import Element
from examples.blind_proof.mujoco.robots import Robot

Array = NDArray[np.float64]

SAMPLE = 0.02
"""Time between samples in s."""

FINER = 5
"""Steps of the recorded robot in a step of the file."""


@dataclass(frozen=True)
class Truth:
    """A robot as it is.

    Attributes:
        robot: as the file has it.
        element: what the file lacks; None for nothing.
        size: of the element.
        factors: of the file's numbers that a diagnosis fits, by the name of a joint or an actuator.
        begin: change of the positions and speeds at the start, both parts one after the other.
    """

    robot: Robot
    element: Element | None = None
    size: float = 0.0
    factors: Mapping[str, float] = field(default_factory=dict)
    begin: tuple[float, ...] = ()


def fitted_numbers(robot: Robot) -> list[str]:
    """Return the joints and actuators whose damping or stiffness the file gives, which a diagnosis fits."""
    model = mujoco.MjModel.from_xml_string(robot.xml)
    joints = [model.joint(k).name for k in range(model.njnt) if model.dof_damping[model.jnt_dofadr[k]] > 0.0]
    actuators = [model.actuator(k).name for k in range(model.nu) if model.actuator_biastype[k] != 0]
    return joints + actuators


def stepped(truth: Truth, controls: Array) -> Array:
    """Return the positions of the measured joints, (N, m), at the times of the controls.

    Args:
        truth: the robot.
        controls: (N, k), held from sample to sample.
    """
    spec = mujoco.MjSpec.from_string(truth.robot.xml)
    if truth.element is not None:
        truth.element.write(spec, truth.size)
    spec.option.timestep /= FINER
    model = spec.compile()
    for name, factor in truth.factors.items():
        _scale(model, name, factor)
    data = mujoco.MjData(model)
    parts = round(SAMPLE / model.opt.timestep)
    begin = np.reshape(truth.begin, (2, -1)) if truth.begin else np.zeros((2, model.nv))
    data.qpos[:] += begin[0]
    data.qvel[:] += begin[1]
    late = np.zeros(model.nu, dtype=int)
    if truth.element is not None and truth.element.late:
        late[model.actuator(truth.element.of).id] = round(truth.size / model.opt.timestep)
    places = [model.jnt_qposadr[model.joint(joint).id] for joint in truth.robot.joints]
    seen, numbers = np.empty((len(controls), len(places))), np.arange(model.nu)
    for row in range(len(controls)):
        seen[row] = data.qpos[places]
        for part in range(parts):
            data.ctrl[:] = controls[np.maximum(row * parts + part - late, 0) // parts, numbers]
            mujoco.mj_step(model, data)
    return seen


def _scale(model: mujoco.MjModel, name: str, factor: float) -> None:
    """Scale the damping of a joint, or the stiffness of a position servo."""
    joints = {model.joint(k).name: k for k in range(model.njnt)}
    if name in joints:
        model.dof_damping[model.jnt_dofadr[joints[name]]] *= factor
    else:
        place = model.actuator(name).id
        model.actuator_gainprm[place, 0] *= factor
        model.actuator_biasprm[place, 1] *= factor
