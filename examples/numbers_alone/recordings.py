"""An arm of two links whose recordings have what its model lacks, stepped by MuJoCo at a fifth of the model's step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ARM = """
<mujoco model="arm">
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" type="hinge" axis="0 1 0" damping="0.3"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.8" contype="0" conaffinity="0"/>
      <body name="fore" pos="0 0 -0.3">
        <joint name="elbow" type="hinge" axis="0 1 0" damping="0.2"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.25" size="0.02" mass="0.5" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder_motor" joint="shoulder"/>
    <motor name="elbow_motor" joint="elbow"/>
  </actuator>
  <sensor>
    <jointpos name="shoulder_angle" joint="shoulder"/>
    <jointpos name="elbow_angle" joint="elbow"/>
  </sensor>
</mujoco>
"""

JOINTS = ("shoulder", "elbow")
MOTORS = ("shoulder_motor", "elbow_motor")
NUMBERS = {"shoulder_damping": 0.3, "elbow_damping": 0.2}
"""The numbers that are fitted, at the values of the file, in N m s/rad."""
SAMPLE = 0.02
"""Time between samples in s."""
NOISE = 0.001
"""Standard deviation of the encoders' white noise in rad."""
_FINER = 5


@dataclass(frozen=True)
class Hidden:
    """What the recordings have and the model lacks.

    Attributes:
        name: in words.
        change: of the specification.
        delay: of the commands in s.
    """

    name: str
    change: Callable[[Any], None] = lambda _: None
    delay: float = 0.0


def _friction(spec: Any) -> None:
    spec.joint("elbow").frictionloss = 0.12


def _payload(spec: Any) -> None:
    spec.body("fore").add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01, 0, 0], pos=[0, 0, -0.25], mass=0.15, contype=0, conaffinity=0
    )


HIDDEN = (
    Hidden("nothing"),
    Hidden("dry friction of .12 N m at the elbow", _friction),
    Hidden("a payload of .15 kg", _payload),
    Hidden("commands .06 s late", delay=0.06),
)


def commands(samples: int, seed: int) -> Array:
    """Torques of both motors in N m, (samples, 2): slow waves of random phase."""
    draw, time = np.random.default_rng(seed), SAMPLE * np.arange(samples)
    rates, phases = np.array([[0.9, 2.3, 4.1], [1.3, 2.9, 4.7]]), draw.uniform(0.0, 2.0 * np.pi, (2, 3))
    sizes = np.array([[1.2, 0.8, 0.5], [0.4, 0.3, 0.2]])
    waves = sizes[..., None] * np.sin(rates[..., None] * time + phases[..., None])
    found: Array = waves.sum(1).T
    return found


def recorded(hidden: Hidden, samples: int, seed: int) -> dict[str, Array]:
    """A recording: ``time``, a torque for each motor, an angle for each joint."""
    spec = mujoco.MjSpec.from_string(ARM)
    hidden.change(spec)
    spec.option.timestep /= _FINER
    model = spec.compile()
    data, given = mujoco.MjData(model), commands(samples, seed)
    steps = round(SAMPLE / model.opt.timestep)
    late = round(hidden.delay / model.opt.timestep)
    angles = np.empty((samples, 2))
    for k in range(samples):
        angles[k] = data.qpos
        for part in range(steps):
            data.ctrl[:] = given[max(k * steps + part - late, 0) // steps]
            mujoco.mj_step(model, data)
    angles += NOISE * np.random.default_rng(seed + 1000).normal(size=angles.shape)
    columns = zip((*MOTORS, *JOINTS), np.concatenate([given, angles], 1).T, strict=True)
    return {"time": SAMPLE * np.arange(samples), **dict(columns)}
