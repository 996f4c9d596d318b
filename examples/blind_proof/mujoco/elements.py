"""Elements of MuJoCo that a user's file lacks, with the names that a diagnosis has for them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

Size = tuple[float, float]
"""Smallest and largest size that is drawn."""


@dataclass(frozen=True)
class Element:
    """An element that recordings have and the user's file lacks.

    Attributes:
        effect: id of the effect in the catalogue.
        form: how MuJoCo makes it.
        at: where it acts, as findings state it.
        sizes: range of the sizes, in the finding's unit.
        write: adds it to a specification; the second argument is its size.
        late: whether the size is instead the time in s by which the command of the actuator ``of`` is late.
        of: the joint, actuator or body.
    """

    effect: str
    form: str
    at: tuple[str, ...]
    sizes: Size
    write: Callable[[Any, float], None]
    late: bool = False
    of: str = ""


def friction(joint: str, sizes: Size) -> Element:
    def write(spec: Any, size: float) -> None:
        spec.joint(joint).frictionloss = size

    return Element("coulomb_friction", "frictionloss", (f"input {joint}_force",), sizes, write, of=joint)


def stop(joint: str, sizes: Size) -> Element:
    """Return a limit of a joint on its negative side."""

    def write(spec: Any, size: float) -> None:
        spec.joint(joint).limited = mujoco.mjtLimited.mjLIMITED_TRUE
        spec.joint(joint).range = [-size, 10.0]

    return Element("hard_stop", "limit of the joint", (f"input {joint}_force",), sizes, write, of=joint)


def lag(actuator: str, sizes: Size) -> Element:
    def write(spec: Any, size: float) -> None:
        spec.actuator(actuator).dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
        spec.actuator(actuator).dynprm[0] = size

    return Element("input_lag", "activation by a filter", (f"input {actuator}",), sizes, write, of=actuator)


def delay(actuator: str, sizes: Size) -> Element:
    at = (f"input {actuator}",)
    return Element("input_delay", "commands that arrive late", at, sizes, lambda *_: None, late=True, of=actuator)


def limit(actuator: str, sizes: Size) -> Element:
    def write(spec: Any, size: float) -> None:
        spec.actuator(actuator).ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
        spec.actuator(actuator).ctrlrange = [-size, size]

    return Element("input_saturation", "range of the control", (f"input {actuator}",), sizes, write, of=actuator)


def payload(body: str, place: tuple[float, float, float], sizes: Size) -> Element:
    """Return a small sphere at the centre of mass of a body, ``place``."""

    def write(spec: Any, size: float) -> None:
        sphere = spec.body(body).add_geom()
        sphere.type, sphere.size, sphere.mass = mujoco.mjtGeom.mjGEOM_SPHERE, [0.001, 0.0, 0.0], size
        sphere.pos, sphere.contype, sphere.conaffinity = list(place), 0, 0

    return Element("constant_change", "a sphere", (f"constant {body}_mass",), sizes, write, of=body)


def tilt(sizes: Size) -> Element:
    def write(spec: Any, size: float) -> None:
        spec.option.gravity = [9.81 * np.sin(size), 0.0, -9.81 * np.cos(size)]

    return Element("constant_change", "direction of gravity", ("constant base_tilt_x",), sizes, write)


def inertia(joint: str, sizes: Size) -> Element:
    def write(spec: Any, size: float) -> None:
        spec.joint(joint).armature = size

    return Element("constant_change", "armature", (f"constant {joint}_armature",), sizes, write, of=joint)


def zero(joint: str, sizes: Size) -> Element:
    def write(spec: Any, size: float) -> None:
        spec.joint(joint).ref = size

    return Element("constant_change", "zero of the joint", (f"constant {joint}_ref",), sizes, write, of=joint)
