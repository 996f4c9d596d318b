"""Numbers of a MuJoCo model that a diagnosis takes as known, and of which an effect may find that they differ."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from mkc_torch.simulation.parameter import Parameter

if TYPE_CHECKING:
    import mujoco

_AXES = ("x", "y")
"""Horizontal axes of the base."""

_LENGTH = 2.0
"""Largest factor by which a link's length differs from the file: a longer link would only imitate inertia."""


@dataclass(frozen=True)
class Constant:
    """A number of the model.

    Attributes:
        kind: "mass" of a body, in kg; "centre", distance of its centre of mass from its frame, in m; "armature" of a
            joint, the inertia of its drive; "ref" of a joint, its angle in the pose that the file draws, in rad;
            "distance" of a body from its parent's frame, in m; "tilt" of the base, by which gravity leans towards an
            axis, in rad.
        place: number of the body, the joint or the axis in the model.
        parameter: its value in the file, with bounds and unit.
    """

    kind: Literal["mass", "centre", "armature", "ref", "distance", "tilt"]
    place: int
    parameter: Parameter

    def write(self, model: Any, value: float, original: mujoco.MjModel) -> None:
        """Set the number in a model of which ``original`` is as the file has it."""
        place = self.place
        if self.kind == "mass":
            model.body_mass[place] = value
        elif self.kind == "centre":
            model.body_ipos[place] = original.body_ipos[place] * (value / self.parameter.value)
        elif self.kind == "armature":
            model.dof_armature[place] = value
        elif self.kind == "ref":
            model.qpos0[place] = value
        elif self.kind == "distance":
            model.body_pos[place] = original.body_pos[place] * (value / self.parameter.value)
        else:
            gravity = original.opt.gravity
            model.opt.gravity[place] = gravity[place] + float(np.linalg.norm(gravity)) * math.sin(value)

    def write_to_spec(self, spec: Any, model: mujoco.MjModel) -> None:
        """Set the number in a specification as a model has it, where the number is written."""
        place = self.place
        if self.kind == "tilt":
            spec.option.gravity = model.opt.gravity
        elif self.kind == "armature":
            spec.joints[place].armature = float(model.dof_armature[place])
        elif self.kind == "ref":
            degrees = bool(spec.compiler.degree)
            spec.joints[place].ref = math.degrees(model.qpos0[place]) if degrees else float(model.qpos0[place])
        elif self.kind == "distance":
            spec.bodies[place].pos = model.body_pos[place]
        else:
            body = spec.bodies[place]
            body.explicitinertial, body.mass = True, float(model.body_mass[place])
            body.ipos, body.iquat = model.body_ipos[place], model.body_iquat[place]
            body.inertia, body.fullinertia = model.body_inertia[place], [math.nan] * 6


def constants_of(
    model: Any, joints: Sequence[str], hinges: Sequence[bool], bodies: Sequence[str], taken: Sequence[str]
) -> dict[str, Constant]:
    """The constants by name: masses and centres of outermost bodies, tilts, zeros of hinges, lengths, drives' inertias.

    Args:
        model: the model, whose joints are hinges and slides.
        joints, bodies: their names, as identifiers.
        hinges: whether each joint is a hinge; else it is a slide.
        taken: names that are states, inputs, or numbers that are fitted.
    """
    moves = np.zeros(model.nbody, dtype=bool)
    for k in range(1, model.nbody):
        moves[k] = model.body_dofnum[k] > 0 or moves[model.body_parentid[k]]
    carriers = {int(model.body_parentid[k]) for k in range(1, model.nbody) if model.body_dofnum[k]}
    for k in range(model.nbody - 1, 0, -1):
        if k in carriers:
            carriers.add(int(model.body_parentid[k]))
    found: dict[str, Constant] = {}
    for k in range(1, model.nbody):
        away = float(np.linalg.norm(model.body_pos[k]))
        if model.body_dofnum[k] and k not in carriers:
            mass = Parameter(float(model.body_mass[k]), lower=0.0, unit="kg")
            found[f"{bodies[k]}_mass"] = Constant("mass", k, mass)
            centre = float(np.linalg.norm(model.body_ipos[k]))
            if centre > 0.0:
                found[f"{bodies[k]}_centre"] = Constant("centre", k, Parameter(centre, lower=0.0, unit="m"))
        if model.body_dofnum[k] and moves[model.body_parentid[k]] and away > 0.0:
            length = Parameter(away, lower=away / _LENGTH, upper=away * _LENGTH, unit="m")
            found[f"{bodies[k]}_distance"] = Constant("distance", k, length)
    if model.opt.gravity.any():
        found |= {f"base_tilt_{axis}": Constant("tilt", k, Parameter(0.0, unit="rad")) for k, axis in enumerate(_AXES)}
    for k, joint in enumerate(joints):
        inertia = Parameter(float(model.dof_armature[k]), lower=0.0, unit="kg m²" if hinges[k] else "kg")
        found[f"{joint}_armature"] = Constant("armature", k, inertia)
        if hinges[k] and model.opt.gravity.any():
            found[f"{joint}_ref"] = Constant("ref", k, Parameter(float(model.qpos0[k]), unit="rad"))
    return {name: constant for name, constant in found.items() if name not in taken}
