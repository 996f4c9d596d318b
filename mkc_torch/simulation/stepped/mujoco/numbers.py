"""Numbers of a MuJoCo model that a recording may determine."""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mkc_torch.simulation.parameter import Parameter, SimulationError

_PRIOR = math.log(2.0)
"""Standard deviation of a number about that of the file, as a share of it: a factor of two."""


@dataclass(frozen=True)
class Number:
    """A number of the model.

    Attributes:
        label: "joint:pan.damping" say.
        part: "joint" or "actuator", and its number in the model.
        places: arrays of ``MjModel`` with the index there and the factor of the number.
        value: value in the file.
        unit: its unit.
    """

    label: str
    part: tuple[str, int]
    places: tuple[tuple[str, tuple[int, ...], float], ...]
    value: float
    unit: str

    @property
    def parameter(self) -> Parameter:
        return Parameter(self.value, lower=0.0, unit=self.unit, uncertainty=_PRIOR * self.value)

    def write(self, model: Any, value: float) -> None:
        """Set the number in a model."""
        for array, index, factor in self.places:
            getattr(model, array)[index] = factor * value


def numbers_of(
    model: Any, joints: Sequence[str], hinges: Sequence[bool], actuators: Sequence[str], fitted: Sequence[str] | None
) -> dict[str, Number]:
    """The numbers to fit, by parameter name.

    Args:
        model: the model.
        joints, actuators: their names, as identifiers.
        hinges: whether each joint is a hinge; else it is a slide.
        fitted: patterns of labels; None for damping, armature, friction loss, kp and kv that the file gives.

    Raises:
        SimulationError: a pattern that matches no number, or one whose value is 0, at which no positive number starts.
    """
    known: dict[str, Number] = {}
    for k, joint in enumerate(joints):
        for attribute, array, unit in (
            ("damping", "dof_damping", "N m s/rad" if hinges[k] else "N s/m"),
            ("armature", "dof_armature", "kg m²" if hinges[k] else "kg"),
            ("frictionloss", "dof_frictionloss", "N m" if hinges[k] else "N"),
            ("stiffness", "jnt_stiffness", "N m/rad" if hinges[k] else "N/m"),
        ):
            value = float(getattr(model, array)[k])
            known[f"{joint}_{attribute}"] = Number(
                f"joint:{joint}.{attribute}", ("joint", k), ((array, (k,), 1.0),), value, unit
            )
    for k, actuator in enumerate(actuators):
        gain, bias = float(model.actuator_gainprm[k, 0]), model.actuator_biasprm[k]
        if bias[1] != 0.0 and gain == -bias[1]:
            both = (("actuator_gainprm", (k, 0), 1.0), ("actuator_biasprm", (k, 1), -1.0))
            known[f"{actuator}_kp"] = Number(f"actuator:{actuator}.kp", ("actuator", k), both, gain, "")
        if bias[2] != 0.0 and gain == -bias[2]:
            both = (("actuator_gainprm", (k, 0), 1.0), ("actuator_biasprm", (k, 2), -1.0))
            known[f"{actuator}_kv"] = Number(f"actuator:{actuator}.kv", ("actuator", k), both, gain, "")
        elif bias[2] != 0.0:
            places = (("actuator_biasprm", (k, 2), -1.0),)
            known[f"{actuator}_kv"] = Number(f"actuator:{actuator}.kv", ("actuator", k), places, -float(bias[2]), "")
    if fitted is None:
        return {name: number for name, number in known.items() if number.value > 0.0 and "stiffness" not in name}
    found: dict[str, Number] = {}
    for pattern in fitted:
        matching = {name: number for name, number in known.items() if fnmatch.fnmatchcase(number.label, pattern)}
        if not matching:
            labels = ", ".join(number.label for number in known.values())
            raise SimulationError(f"--fit {pattern}: no number of the model has this name; it has {labels}.")
        found |= {name: number for name, number in matching.items() if number.value > 0.0}
    return found
