"""A pendulum as a stepper, as differential equations, and as a model of MuJoCo."""

import numpy as np
import torch

from mkc_torch.simulation import Dynamics, Parameter, Stepper

PENDULUM = """
<mujoco model="pendulum">
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="rod" pos="0 0 1">
      <joint name="hinge" type="hinge" axis="0 1 0" damping="0.05"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="1" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><motor name="drive" joint="hinge"/></actuator>
  <sensor><jointpos name="encoder" joint="hinge"/></sensor>
</mujoco>
"""

TWO_LINKS = """
<mujoco model="two links">
  <compiler angle="radian"/>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" type="hinge" axis="0 1 0" damping="0.2" frictionloss="0.05"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="1" contype="0" conaffinity="0"/>
      <body name="lower" pos="0 0 -0.4">
        <joint name="elbow" type="hinge" axis="0 1 0" damping="0.1" armature="0.01"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="40" kv="2"/>
    <motor name="elbow_motor" joint="elbow"/>
  </actuator>
</mujoco>
"""

NAMES = {"angle": "rad", "speed": "rad/s", "torque": "N m"}
VALUES = {"inertia": Parameter(0.5, lower=0.0), "weight": 4.0, "damping": 0.1}


class Equations(Dynamics):
    states, inputs, units, parameters = ("angle", "speed"), ("torque",), NAMES, VALUES
    input_hold = "held"

    def derivative(self, time, x, u, p):
        moment = u.torque - p.weight * torch.sin(x.angle) - p.damping * x.speed
        return {"angle": x.speed, "speed": moment / p.inertia}


class Steps(Stepper):
    states, inputs, parameters = ("angle", "speed"), ("torque",), VALUES
    units = {**NAMES, "moment": "N m"}
    positions, forces, time_step = {"angle": "speed"}, {"moment": "speed"}, 0.01

    def step(self, x, u, tau, p, dt):
        def rates(x):
            moment = u[:, 0] + tau[:, 0] - p.weight * np.sin(x[:, 0]) - p.damping * x[:, 1]
            return np.stack([x[:, 1], moment / p.inertia], 1)

        first = rates(x)
        second = rates(x + 0.5 * dt * first)
        third = rates(x + 0.5 * dt * second)
        return x + dt / 6 * (first + 2 * second + 2 * third + rates(x + dt * third))
