"""Names, units, states and fitted numbers of a MuJoCo model."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mkc_torch.simulation.parameter import Parameter, SimulationError
from mkc_torch.simulation.stepped.mujoco.constants import Constant, constants_of
from mkc_torch.simulation.stepped.mujoco.numbers import Number, numbers_of

if TYPE_CHECKING:
    import mujoco


class MjcfError(SimulationError):
    """A MuJoCo model that cannot be used; the message states why."""


@dataclass(frozen=True)
class Description:
    """A MuJoCo model with the names of its states, inputs, forces, sensors and fitted numbers.

    Attributes:
        path: of the file.
        model: the compiled model; its numbers are those of the file.
        name: name of the simulation.
        states: joints, their speeds, then activations of actuators.
        inputs: controls of the actuators.
        positions: joint to its speed.
        forces: force at each joint, to the joint's speed.
        sensors: name of a sensor's value, to its place in MuJoCo's ``sensordata``.
        numbers: numbers of the model that are fitted, by parameter name.
        constants: numbers of which an effect may find that they differ, by name.
        units: by state, input, force and sensor.
        initial: value of each state at the model's initial configuration.
        fitted: the patterns that chose the numbers; None for the default.
        whole: the model with all joints, where only some of them move by simulation; else None.
    """

    path: Path
    model: mujoco.MjModel = field(repr=False)
    name: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    positions: Mapping[str, str]
    forces: Mapping[str, str]
    sensors: Mapping[str, int]
    numbers: Mapping[str, Number]
    constants: Mapping[str, Constant]
    units: Mapping[str, str]
    initial: Mapping[str, float]
    fitted: tuple[str, ...] | None
    whole: Description | None = None

    @property
    def all(self) -> Description:
        """The model with all joints."""
        return self if self.whole is None else self.whole

    @property
    def followed(self) -> tuple[str, ...]:
        """Joints that move as they were recorded."""
        return tuple(name for name in self.all.positions if name not in self.positions)

    @property
    def time_step(self) -> float:
        return float(self.model.opt.timestep)

    @property
    def parameters(self) -> dict[str, Parameter]:
        return {name: number.parameter for name, number in self.numbers.items()}


def described(path: Path, fitted: Sequence[str] | None) -> Description:
    """Read a model.

    Raises:
        MjcfError: MuJoCo refuses the file, or the model has parts that cannot be diagnosed.
        ImportError: MuJoCo is not installed.
    """
    mujoco = the_library()
    if not path.is_file():
        raise MjcfError(f"{path}: there is no such file.")
    from mkc_torch.simulation.stepped.mujoco.visuals import drop_visuals

    try:
        spec = mujoco.MjSpec.from_file(str(path))
        drop_visuals(spec)
        drives = _sense_drives(spec)
        model = spec.compile()
    except ValueError as error:
        raise MjcfError(f"{path}: MuJoCo refuses the model: {error}") from None
    hinge_kind, slide_kind = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
    other = [k for k in range(model.njnt) if model.jnt_type[k] not in (hinge_kind, slide_kind)]
    if other:
        label = _name(model, mujoco.mjtObj.mjOBJ_JOINT, other[0]) or f"number {other[0]}"
        raise MjcfError(
            f"{path}: joint {label} is free or a ball; a diagnosis needs a model whose joints are hinges and slides, "
            "as of an arm on a table. Fix the body, or give it hinges and slides."
        )
    if not model.njnt:
        raise MjcfError(f"{path}: the model has no joint, and so nothing that moves.")
    joints = [_identifier(_name(model, mujoco.mjtObj.mjOBJ_JOINT, k) or f"joint{k}") for k in range(model.njnt)]
    actuators = [_identifier(_name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, k) or f"actuator{k}") for k in range(model.nu)]
    controls = tuple(f"{name}_ctrl" if name in joints else name for name in actuators)
    speeds = tuple(f"{name}_vel" for name in joints)
    acting = tuple(f"{actuators[k]}_act" for k in range(model.nu) for _ in range(max(int(model.actuator_actnum[k]), 0)))
    acting = tuple(f"{name}{acting[:k].count(name) or ''}" for k, name in enumerate(acting))
    states = (*joints, *speeds, *acting)
    names = [*states, *controls]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise MjcfError(f"{path}: two parts of the model have the name `{twice[0]}` here; rename one of them.")
    hinges = [bool(model.jnt_type[k] == hinge_kind) for k in range(model.njnt)]
    units = {name: "rad" if hinge else "m" for name, hinge in zip(joints, hinges, strict=True)}
    units |= {name: "rad/s" if hinge else "m/s" for name, hinge in zip(speeds, hinges, strict=True)}
    forces = {f"{name}_force": speed for name, speed in zip(joints, speeds, strict=True)}
    units |= {name: "N m" if hinge else "N" for name, hinge in zip(forces, hinges, strict=True)}
    for k, name in enumerate(controls):
        if (unit := _unit_of_control(model, k, units, joints)) is not None:
            units[name] = unit
    units |= {_identifier(name): "N m" if hinge else "N" for name, hinge in drives.items()}
    numbers = numbers_of(model, joints, hinges, actuators, fitted)
    bodies = [_identifier(_name(model, mujoco.mjtObj.mjOBJ_BODY, k) or f"body{k}") for k in range(model.nbody)]
    first = mujoco.MjData(model)
    values = [*first.qpos, *first.qvel, *first.act]
    return Description(
        path,
        model,
        _identifier(path.stem.title().replace("_", "").replace("-", "")),
        states,
        controls,
        dict(zip(joints, speeds, strict=True)),
        forces,
        {name: place for name, place in _sensors(model).items() if name not in names},
        numbers,
        constants_of(model, joints, hinges, bodies, (*names, *forces, *numbers)),
        units,
        dict(zip(states, map(float, values), strict=True)),
        None if fitted is None else tuple(fitted),
    )


def the_library() -> Any:
    """The module mujoco.

    Raises:
        ImportError: MuJoCo is not installed.
    """
    try:
        import mujoco
    except ImportError as error:
        raise ImportError(
            "Models of MuJoCo need the extra `mujoco`: pip install -e '.[mujoco]' in the repository's folder."
        ) from error
    return mujoco


def _sense_drives(spec: Any) -> dict[str, bool]:
    """Add a sensor of the actuators' force at each named joint; name of the sensor to whether the joint is a hinge."""
    mujoco = the_library()
    taken, found = {sensor.name for sensor in spec.sensors}, {}
    for joint in list(spec.joints):
        hinge = joint.type == mujoco.mjtJoint.mjJNT_HINGE
        name = f"{joint.name}_torque" if hinge else f"{joint.name}_effort"
        if joint.name and name not in taken and (hinge or joint.type == mujoco.mjtJoint.mjJNT_SLIDE):
            of = {"objtype": mujoco.mjtObj.mjOBJ_JOINT, "objname": joint.name}
            spec.add_sensor(name=name, type=mujoco.mjtSensor.mjSENS_JOINTACTFRC, **of)
            found[name] = hinge
    return found


def _name(model: Any, kind: Any, number: int) -> str | None:
    found: str | None = the_library().mj_id2name(model, kind, number)
    return found


def _identifier(name: str) -> str:
    """The name as a Python identifier.

    Example:
        >>> _identifier("left/knee-1"), _identifier("3rd")
        ('left_knee_1', '_3rd')
    """
    text = re.sub(r"\W", "_", name)
    return f"_{text}" if text[:1].isdigit() or not text else text


def _unit_of_control(model: Any, number: int, units: Mapping[str, str], joints: Sequence[str]) -> str | None:
    """The unit of an actuator's control: of a position servo that of its joint, of a motor that of its force."""
    mujoco = the_library()
    if model.actuator_trntype[number] != int(mujoco.mjtTrn.mjTRN_JOINT):
        return None
    joint = joints[int(model.actuator_trnid[number, 0])]
    rotation = units[joint] == "rad"
    gain, bias = model.actuator_gainprm[number, 0], model.actuator_biasprm[number]
    if bias[1] != 0.0 and gain == -bias[1]:
        return units[joint]
    if bias[2] != 0.0 and gain == -bias[2]:
        return units[f"{joint}_vel"]
    return ("N m" if rotation else "N") if gain == 1.0 and not bias.any() else None


def _sensors(model: Any) -> dict[str, int]:
    """Name of each value of the named sensors, to its place in ``sensordata``."""
    mujoco = the_library()
    found: dict[str, int] = {}
    for k in range(model.nsensor):
        name = _name(model, mujoco.mjtObj.mjOBJ_SENSOR, k)
        if not name:
            continue
        size, place = int(model.sensor_dim[k]), int(model.sensor_adr[k])
        quaternion = model.sensor_datatype[k] == int(mujoco.mjtDataType.mjDATATYPE_QUATERNION)
        ends = ("_w", "_x", "_y", "_z") if quaternion else ("_x", "_y", "_z")
        tails = [""] if size == 1 else ends if size == len(ends) else [f"_{i}" for i in range(size)]
        found |= {f"{_identifier(name)}{tail}": place + i for i, tail in enumerate(tails)}
    return found
