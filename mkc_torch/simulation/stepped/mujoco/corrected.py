"""A MuJoCo model's file with fitted numbers and with what a joint may have more, by MuJoCo's own ``MjSpec``."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import mujoco

from mkc_torch.simulation.stepped.mujoco.description import Description
from mkc_torch.simulation.stepped.mujoco.visuals import drop_visuals

_OF_ACTUATORS = {"actuator_gainprm": "gainprm", "actuator_biasprm": "biasprm"}


def corrected_xml(
    description: Description,
    values: Mapping[str, float],
    added: Mapping[tuple[str, str], float],
    changed: Mapping[str, float] = MappingProxyType({}),
    note: str = "",
) -> str:
    """Return the model as MJCF with other numbers.

    Args:
        description: the model.
        values: fitted number by parameter name.
        added: joint and attribute, ("elbow", "frictionloss") say, to what is added to the attribute, in its unit.
        changed: change of a constant by its name.
        note: appended to the comment at the top of the file.

    Where files of meshes are missing, the parts that only are seen are left out.

    Example:
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> from mkc_torch.simulation.stepped.mujoco.description import described
        >>> joint = '<joint name="pan" damping=".5"/><geom size=".1" mass="1"/>'
        >>> text = f"<mujoco><worldbody><body>{joint}</body></worldbody></mujoco>"
        >>> with TemporaryDirectory() as folder:
        ...     _ = (Path(folder) / "arm.xml").write_text(text)
        ...     found = corrected_xml(described(Path(folder) / "arm.xml", None), {"pan_damping": 0.75}, {})
        >>> 'damping="0.75"' in found
        True
    """
    spec = mujoco.MjSpec.from_file(str(description.path))
    for name, value in values.items():
        number = description.all.numbers[name]
        kind, place = number.part
        if kind == "joint":
            _set(spec.joints[place], number.label.rpartition(".")[2], value)
            continue
        for array, index, factor in number.places:
            getattr(spec.actuators[place], _OF_ACTUATORS[array])[index[1]] = factor * value
    joints = list(description.all.positions)
    for (joint, attribute), amount in added.items():
        part = spec.joints[joints.index(joint)]
        _set(part, attribute, _linear(getattr(part, attribute)) + amount)
    other = copy.copy(description.model)
    for name, change in changed.items():
        constant = description.all.constants[name]
        constant.write(other, constant.parameter.value + change, description.model)
        constant.write_to_spec(spec, other)
    if note:
        spec.comment = f"{spec.comment} {note}".strip()
    try:
        text: str = spec.to_xml()
    except ValueError:  # files of meshes are missing
        drop_visuals(spec)
        text = spec.to_xml()
    return text


def _linear(value: Any) -> float:
    """An attribute's number; of a polynomial that MuJoCo 4 has for damping and stiffness, its linear term."""
    return float(value[0]) if hasattr(value, "__len__") else float(value)


def _set(part: Any, attribute: str, value: float) -> None:
    known = getattr(part, attribute)
    setattr(part, attribute, [value, *known[1:]] if hasattr(known, "__len__") else value)
