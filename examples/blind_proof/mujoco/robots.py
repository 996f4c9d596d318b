"""Five robots as a user's files have them, with their commands and the elements that their recordings can have."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from examples.blind_proof.mujoco import elements
from examples.blind_proof.mujoco.elements import Element

_HEAD = """
  <compiler angle="radian"/>
  <option timestep="0.005" integrator="implicitfast"/>
  <default><geom contype="0" conaffinity="0"/></default>
"""

_CART_POLE = f"""
<mujoco model="cart_pole">{_HEAD}
  <worldbody>
    <body name="cart" pos="0 0 1">
      <joint name="slide" type="slide" axis="1 0 0" damping="1.5"/>
      <geom type="box" size="0.1 0.05 0.05" mass="1"/>
      <body name="pole">
        <joint name="hinge" type="hinge" axis="0 1 0" damping="0.01"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.01" mass="0.3"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="slide"/></actuator>
</mujoco>
"""

_ARM = f"""
<mujoco model="arm">{_HEAD}
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" type="hinge" axis="0 1 0" damping="0.2"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="1"/>
      <body name="fore" pos="0 0 -0.4">
        <joint name="elbow" type="hinge" axis="0 1 0" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="first" joint="shoulder"/><motor name="second" joint="elbow"/></actuator>
</mujoco>
"""

_SERVO_ARM = f"""
<mujoco model="servo_arm">{_HEAD}
  <worldbody>
    <body name="base" pos="0 0 0.1">
      <joint name="pan" type="hinge" axis="0 0 1" damping="0.6"/>
      <geom type="box" size="0.03 0.03 0.03" mass="0.1"/>
      <body name="upper">
        <joint name="lift" type="hinge" axis="0 1 0" damping="0.6"/>
        <geom type="capsule" fromto="0 0 0 0.12 0 0.02" size="0.015" mass="0.1"/>
        <body name="fore" pos="0.12 0 0.02">
          <joint name="bend" type="hinge" axis="0 1 0" damping="0.6"/>
          <geom type="capsule" fromto="0 0 0 0.13 0 0" size="0.015" mass="0.15"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="pan_servo" joint="pan" kp="18"/>
    <position name="lift_servo" joint="lift" kp="18"/>
    <position name="bend_servo" joint="bend" kp="18"/>
  </actuator>
</mujoco>
"""

_LEG = f"""
<mujoco model="leg">{_HEAD}
  <worldbody>
    <body name="thigh" pos="0 0 1">
      <joint name="hip" type="hinge" axis="0 1 0" damping="0.4" armature="0.01"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="1.2"/>
      <body name="shank" pos="0 0 -0.2">
        <joint name="knee" type="hinge" axis="0 1 0" damping="0.3"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.22" size="0.012" mass="0.25"/>
        <geom name="foot" type="sphere" pos="0 0 -0.22" size="0.02" mass="0.06"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="hip_motor" joint="hip" gear="8"/><motor name="knee_motor" joint="knee" gear="8"/></actuator>
</mujoco>
"""

_CRANE = f"""
<mujoco model="crane">{_HEAD}
  <worldbody>
    <body name="trolley" pos="0 0 3">
      <joint name="travel" type="slide" axis="1 0 0" damping="20"/>
      <geom type="box" size="0.2 0.1 0.05" mass="8"/>
      <body name="rope">
        <joint name="sway" type="hinge" axis="0 1 0" damping="0.2"/>
        <geom type="capsule" fromto="0 0 0 0 0 -1.2" size="0.01" mass="0.2"/>
        <geom name="load" type="sphere" pos="0 0 -1.2" size="0.05" mass="3"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="drive" joint="travel"/></actuator>
</mujoco>
"""


@dataclass(frozen=True)
class Robot:
    """A robot of a user.

    Attributes:
        name: of its model.
        xml: the user's file.
        joints: measured joints, which name the outputs.
        commands: for each actuator the size of its command, in its unit.
        slowest: period of the slowest wave of the commands in s.
        elements: what its recordings can have and the file lacks.
    """

    name: str
    xml: str
    joints: tuple[str, ...]
    commands: Mapping[str, float]
    slowest: float
    elements: Sequence[Element]


ROBOTS: Mapping[str, Robot] = MappingProxyType(
    {
        robot.name: robot
        for robot in (
            Robot(
                "cart_pole",
                _CART_POLE,
                ("slide", "hinge"),
                {"motor": 4.0},
                3.0,
                (
                    elements.friction("slide", (0.12, 1.2)),
                    elements.friction("hinge", (0.0018, 0.02)),
                    elements.lag("motor", (0.009, 0.1)),
                    elements.delay("motor", (0.012, 0.1)),
                    elements.limit("motor", (2.5, 4.5)),
                    elements.payload("pole", (0.0, 0.0, -0.2), (0.009, 0.12)),
                ),
            ),
            Robot(
                "arm",
                _ARM,
                ("shoulder", "elbow"),
                {"first": 2.5, "second": 0.5},
                4.0,
                (
                    elements.friction("shoulder", (0.024, 0.25)),
                    elements.friction("elbow", (0.009, 0.08)),
                    elements.stop("elbow", (0.3, 0.5)),
                    elements.lag("second", (0.009, 0.08)),
                    elements.delay("first", (0.012, 0.1)),
                    elements.limit("first", (1.2, 2.2)),
                    elements.payload("fore", (0.0, 0.0, -0.15), (0.015, 0.15)),
                    elements.tilt((0.01, 0.1)),
                    elements.inertia("elbow", (0.0009, 0.01)),
                    elements.zero("elbow", (0.015, 0.15)),
                ),
            ),
            Robot(
                "servo_arm",
                _SERVO_ARM,
                ("pan", "lift", "bend"),
                {"pan_servo": 0.7, "lift_servo": 0.5, "bend_servo": 0.5},
                5.0,
                (
                    elements.friction("pan", (0.03, 0.4)),
                    elements.friction("lift", (0.03, 0.4)),
                    elements.lag("pan_servo", (0.012, 0.1)),
                    elements.delay("lift_servo", (0.012, 0.1)),
                    elements.payload("fore", (0.065, 0.0, 0.0), (0.03, 0.3)),
                ),
            ),
            Robot(
                "leg",
                _LEG,
                ("hip", "knee"),
                {"hip_motor": 0.35, "knee_motor": 0.06},
                2.5,
                (
                    elements.friction("hip", (0.045, 0.5)),
                    elements.friction("knee", (0.012, 0.12)),
                    elements.delay("hip_motor", (0.006, 0.06)),
                    elements.lag("knee_motor", (0.006, 0.06)),
                    elements.limit("hip_motor", (0.2, 0.35)),
                    elements.inertia("knee", (0.0009, 0.01)),
                ),
            ),
            Robot(
                "crane",
                _CRANE,
                ("travel", "sway"),
                {"drive": 60.0},
                6.0,
                (
                    elements.friction("travel", (1.2, 15.0)),
                    elements.delay("drive", (0.015, 0.2)),
                    elements.lag("drive", (0.015, 0.2)),
                    elements.limit("drive", (35.0, 60.0)),
                    elements.payload("rope", (0.0, 0.0, -1.1625), (0.15, 2.0)),
                ),
            ),
        )
    }
)
"""By the name of the model."""
