"""A MuJoCo model as a simulation that steps."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeGuard

import numpy as np

from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.dynamics.correction import DynamicsCorrection
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics
from mkc_torch.simulation.foreign.model_file import model_file
from mkc_torch.simulation.names import Names
from mkc_torch.simulation.parameter import SimulationError
from mkc_torch.simulation.stepped.evaluation import SingleStep
from mkc_torch.simulation.stepped.mujoco.description import Description, described
from mkc_torch.simulation.stepped.mujoco.following import with_followed, with_moving
from mkc_torch.simulation.stepped.stepper import Stepper

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


class MujocoStepper(Stepper):
    """A MuJoCo model; :func:`mjcf_class` makes a class of a file, with its names, parameters and units.

    The states are the positions and speeds of its joints and the activations of its actuators; each step is MuJoCo's
    own, with the model's integrator and time step. Forces act at the joints (``qfrc_applied``), through the masses.

    Attributes:
        description: the model with its names.
    """

    description: ClassVar[Description]

    def step(  # type: ignore[override]
        self, x: Array, u: Array, tau: Array, p: Names, dt: float
    ) -> Array:
        return self._engine.stepped(x, u, tau, vars(p))[0]

    def rollout(self, x: Array, u: Array, tau: Array, p: Names, dt: float) -> Array:
        return self._engine.rolled_out(x, u, tau, vars(p))

    def single(self) -> SingleStep:
        found: SingleStep = self._engine.single()
        return found

    def sensed(self, x: Array, u: Array, p: Names) -> Mapping[str, Array]:
        shown = self._engine.stepped(x, u, np.zeros((len(x), len(self.forces))), vars(p))[1]
        return {name: shown[:, place] for name, place in self.description.sensors.items()}

    def prepare(self, recording: Recording) -> PreparedDynamics:
        """The simulation together with a recording.

        Raises:
            MissingColumnError: the recording lacks ``time`` or the control of an actuator.
            SimulationError: none of the joints and sensors is a column of the recording.
        """
        shown = (*self.states, *self.description.sensors)
        measured = self.outputs or tuple(name for name in shown if name in recording)
        if not measured:
            raise SimulationError(
                f"{self.name}: no joint and no sensor of the model is a column of the recording. The model has "
                f"{', '.join(shown)}; the recording has {', '.join(recording.names)}. Assign the columns with "
                "--columns NAME=COLUMN."
            )
        own = copy.copy(self)
        own.__dict__.pop("_evaluation", None)
        own.outputs = measured
        if self.followed and self.followed[0] not in recording:  # a prepared recording has them already
            recording = with_followed(recording, self.description)
        return super(MujocoStepper, own).prepare(recording)

    @property
    def columns(self) -> frozenset[str]:
        # the motion and the drives of joints that are followed take part through the former alone
        return super().columns | frozenset(self.description.all.states) | frozenset(self.description.all.inputs)

    @property
    def saved(self) -> Mapping[str, object]:  # type: ignore[override]
        """The patterns that chose the fitted numbers, and the joints that move by simulation if not all do."""
        found, patterns = self.description, self.description.fitted
        joints = {} if found.whole is None else {"joints": list(found.positions)}
        return joints if patterns is None else {"fitted": list(patterns), **joints}

    def correction(self, state: Mapping[str, Any], recording: Recording) -> DynamicsCorrection:
        chosen = {key: state[key] for key in ("fitted", "joints") if key in state}
        if is_of_a_model(type(self)) and chosen != self.saved:
            return load_mjcf(self.description.path, **chosen).correction(state, recording)
        return super().correction(state, recording)

    def moving(self, joints: Sequence[str]) -> MujocoStepper:
        """Return the model with only some joints moved by simulation; see :func:`load_mjcf`."""
        return _class_of(with_moving(self.description.all, joints))()

    def __reduce__(self) -> Any:
        state = {name: value for name, value in vars(self).items() if name not in ("_engine", "_evaluation")}
        if is_of_a_model(type(self)):  # such a class cannot be imported by name
            return load_mjcf, (str(self.description.path), self.description.fitted, self.saved.get("joints")), state
        return type(self), (), state

    @cached_property
    def _engine(self) -> Any:
        from mkc_torch.simulation.stepped.mujoco.engine import Engine

        return Engine(self.description)


def load_mjcf(
    path: str | Path, fitted: Sequence[str] | None = None, joints: Sequence[str] | None = None
) -> MujocoStepper:
    """Load a MuJoCo model, MJCF or URDF.

    Args:
        path: of the file.
        fitted: patterns of the numbers to fit, "joint:*.damping" say; None for those that the file gives.
        joints: those that move by simulation; the others move as they were recorded. None for all.

    Raises:
        MjcfError: MuJoCo refuses the file, the model has parts that cannot be diagnosed, or it has no such joint.
        ImportError: MuJoCo is not installed.
    """
    return _class_of(_described(Path(path), fitted, joints))()


def mjcf_class(
    path: str | Path,
    file: str | None = None,
    fitted: Sequence[str] | None = None,
    joints: Sequence[str] | None = None,
) -> type[MujocoStepper]:
    """A class of a MuJoCo model, to derive from like :class:`mkc_torch.simulation.Stepper`.

    Args:
        path: of the MJCF or URDF file.
        file: ``__file__`` of the calling file, to whose folder the path is relative; None for the current folder.
        fitted, joints: as in :func:`load_mjcf`.

    Raises:
        MjcfError: MuJoCo refuses the file, the model has parts that cannot be diagnosed, or it has no such joint.
        ImportError: MuJoCo is not installed.
    """
    return _class_of(_described(model_file(path, file), fitted, joints))


def _described(path: Path, fitted: Sequence[str] | None, joints: Sequence[str] | None) -> Description:
    found = described(path, fitted)
    return found if joints is None else with_moving(found, joints)


def is_of_a_model(kind: type) -> TypeGuard[type[MujocoStepper]]:
    """Whether a class was made of a MuJoCo model, and not derived from such a class.

    Example:
        >>> is_of_a_model(dict)
        False
    """
    return issubclass(kind, MujocoStepper) and "description" in vars(kind)


def _class_of(found: Description) -> type[MujocoStepper]:
    body = {
        "__doc__": f"The model {found.path.name}.",
        "description": found,
        "states": found.states,
        "inputs": found.inputs,
        "positions": found.positions,
        "forces": found.forces,
        "followed": tuple(name for name in found.inputs if name not in found.all.inputs),
        "parameters": found.parameters,
        "constants": {name: constant.parameter for name, constant in found.constants.items()},
        "units": found.units,
        "initial": found.initial,
        "time_step": found.time_step,
        "step": MujocoStepper.step,
    }
    return type(found.name, (MujocoStepper,), body)
