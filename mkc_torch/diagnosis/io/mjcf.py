"""Export of a MuJoCo model with findings as MJCF."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from typing import TYPE_CHECKING

from mkc_torch.simulation.stepped.mujoco.stepper import MujocoStepper

if TYPE_CHECKING:
    from torch import Tensor

    from mkc_torch.diagnosis.model.term import Term

Part = tuple[MujocoStepper, Sequence[float], Sequence["Term"], Sequence["Tensor"]]
"""A diagnosed model: the simulation, its parameters, its effects and their sizes."""

_ATTRIBUTES = {"coulomb_friction": "frictionloss", "linear_drag": "damping"}
"""Attribute of a joint by the effect that it expresses; its number is the effect's size."""


def mjcf_source(parts: Sequence[Part]) -> tuple[str, tuple[str, ...]]:
    """Return a model's file with the fitted numbers and the findings that MJCF expresses, and the other findings.

    Args:
        parts: the diagnosed model; several where its joints were diagnosed one by one.

    Returns:
        The MJCF, and a line for each finding that is not in it, which ``corrected.py`` has.
    """
    from mkc_torch.simulation.stepped.mujoco.corrected import corrected_xml

    values: dict[str, float] = {}
    added: dict[tuple[str, str], float] = {}
    changed: dict[str, float] = {}
    others: list[str] = []
    for system, theta, terms, gammas in parts:
        joints = {force: joint for joint, force in zip(system.positions, system.forces, strict=True)}
        values |= dict(zip(system.parameters, theta, strict=False))
        for term, gamma in zip(terms, gammas, strict=True):
            if term.port.startswith("constant "):
                name = term.port.removeprefix("constant ")
                changed[name] = changed.get(name, 0.0) + float(gamma[0])
                continue
            joint = joints.get(term.port.rpartition("entry of ")[2])
            attribute = _ATTRIBUTES.get(term.effect.id)
            if joint is None or attribute is None or term.driver is not None or not float(gamma[0]) > 0.0:
                others.append(f"{term.effect.display_name} at the {term.port.rpartition('entry of ')[2]}")
                continue
            added[joint, attribute] = added.get((joint, attribute), 0.0) + float(gamma[0])
    only = f" Only corrected.py has: {'; '.join(others)}." if others else ""
    note = f"With the findings of mkc diagnose.{only}".replace("--", "-")  # a comment cannot hold two hyphens
    return corrected_xml(parts[0][0].description, values, added, changed, note), tuple(others)


def mjcf_changes(system: MujocoStepper, text: str) -> str:
    """Return the lines of a model's file that differ in another, as a unified diff.

    Both are as MuJoCo writes them, so that only numbers and attributes differ, not the order or the spaces.

    Args:
        system: the diagnosed model.
        text: the other file.
    """
    from mkc_torch.simulation.stepped.mujoco.corrected import corrected_xml

    plain = corrected_xml(system.description, {}, {})
    lines = difflib.unified_diff(
        plain.splitlines(), text.splitlines(), system.description.path.name, "corrected.xml", lineterm="", n=1
    )
    return "\n".join(lines)
