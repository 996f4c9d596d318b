"""Some joints of a MuJoCo model move by simulation, and the others as they were recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.dynamics.first_guess import despiked, slope_of
from mkc_torch.simulation.runs import experiment_runs
from mkc_torch.simulation.stepped.mujoco.description import Description, MjcfError, the_library

if TYPE_CHECKING:
    from torch import Tensor

_DERIVATIVES = {"": "", "_vel": "/s", "_acc": "/s²"}
"""Endings of the names of a followed joint's position, speed and acceleration, and of their units."""


def with_moving(whole: Description, joints: Sequence[str]) -> Description:
    """Return the part of a model in which only some joints move by simulation.

    The positions, speeds and accelerations of the others are inputs; their drives, friction and limits do nothing.

    Args:
        whole: the model.
        joints: those that move.

    Raises:
        MjcfError: the model has no such joint.
    """
    unknown = [name for name in joints if name not in whole.positions]
    if unknown or not joints:
        raise MjcfError(
            f"{whole.path}: joints expected some of {', '.join(whole.positions)}, got "
            f"{', '.join(unknown) or 'none'}; write the names as here."
        )
    model, mujoco = whole.model, the_library()
    own = [number for number, name in enumerate(whole.positions) if name in joints]
    of_joints = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    idle = [
        k for k in range(model.nu) if model.actuator_trntype[k] in of_joints and model.actuator_trnid[k, 0] not in own
    ]
    positions = {name: speed for name, speed in whole.positions.items() if name in joints}
    n = len(whole.positions)
    acting = [k for k in range(model.nu) for _ in range(max(int(model.actuator_actnum[k]), 0))]
    active = [name for name, k in zip(whole.states[2 * n :], acting, strict=True) if k not in idle]
    followed = [name for name in whole.positions if name not in joints]
    units = {
        f"{name}_followed{tail}": whole.units[name] + per for name in followed for tail, per in _DERIVATIVES.items()
    }
    elsewhere = {number for number in range(n) if number not in own}
    on_joint = int(mujoco.mjtObj.mjOBJ_JOINT)
    hidden = {
        int(model.sensor_adr[k])
        for k in range(model.nsensor)
        if model.sensor_objtype[k] == on_joint and int(model.sensor_objid[k]) in elsewhere
    }
    return replace(
        whole,
        states=(*positions, *positions.values(), *active),
        inputs=(*(name for k, name in enumerate(whole.inputs) if k not in idle), *units),
        positions=positions,
        forces={name: speed for name, speed in whole.forces.items() if speed in positions.values()},
        sensors={name: place for name, place in whole.sensors.items() if place not in hidden},
        numbers={
            name: number
            for name, number in whole.numbers.items()
            if (number.part[1] in own if number.part[0] == "joint" else number.part[1] not in idle)
        },
        constants={
            name: constant
            for name, constant in whole.constants.items()
            if constant.kind not in ("armature", "ref") or constant.place in own
        },
        units={**whole.units, **units},
        whole=whole,
    )


def with_followed(recording: Recording, description: Description) -> Recording:
    """Return a recording with the columns of the joints that follow it.

    Args:
        recording: with a column of positions for each of these joints; speeds are used where there are any.
        description: of the model.

    Raises:
        MjcfError: such a column is missing.
    """
    missing = [name for name in description.followed if name not in recording]
    if missing:
        raise MjcfError(
            f"{description.name}: joint {missing[0]} is to follow its recorded position, but the recording has no "
            f"column `{missing[0]}`. Assign the column with --columns {missing[0]}=COLUMN, or let all joints move."
        )
    finite = recording["time"].isfinite()
    run = experiment_runs(recording.rows(finite))
    begins = torch.cat([run.new_ones(1, dtype=torch.bool), run[1:] != run[:-1]])
    columns: dict[str, Tensor] = {}
    for name in description.followed:
        speed = f"{name}_vel"
        known = finite.clone() & recording[name].isfinite()
        place = despiked(torch.where(known, recording[name], 0.0)[finite], recording["time"][finite], begins)
        time = recording["time"][finite]
        rate = recording[speed][finite] if speed in recording else slope_of(place, time, begins)
        for tail, values in zip(_DERIVATIVES, (place, rate, slope_of(rate, time, begins)), strict=True):
            column = torch.full_like(recording["time"], torch.nan)
            column[finite] = torch.where(known[finite], values, torch.nan)
            columns[f"{name}_followed{tail}"] = column
    return Recording(
        {**recording.columns, **columns},
        name=recording.name,
        units={**recording.units, **{name: description.units[name] for name in columns}},
        warnings=recording.warnings,
        labels=recording.labels,
        notes=recording.notes,
    )
