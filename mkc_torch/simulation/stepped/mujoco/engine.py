"""Batches of single steps of a MuJoCo model."""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from mujoco import rollout

from mkc_torch._parallel.processes import cores
from mkc_torch.simulation.names import Names
from mkc_torch.simulation.stepped.evaluation import SingleStep
from mkc_torch.simulation.stepped.mujoco.description import Description

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]
    Places = NDArray[np.int64]
    Mask = NDArray[np.bool_]

_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
_MOTION = mujoco.mjtState.mjSTATE_QPOS | mujoco.mjtState.mjSTATE_QVEL | mujoco.mjtState.mjSTATE_ACT
_CONTROL = mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_QFRC_APPLIED

_GIVEN = _MOTION | mujoco.mjtState.mjSTATE_WARMSTART | _CONTROL

_HEAVY = 1e4
"""Inertia of a joint that is followed, as a multiple of the largest of the model; far larger ones slow MuJoCo down."""

_HUGE = 1e6
"""Size of a state or a control beyond which a step is not computed; no mechanism reaches it."""


class Engine:
    """A copy of a model whose numbers may be set, and MuJoCo's own thread pool.

    Args:
        description: the model.
    """

    def __init__(self, description: Description) -> None:
        self.description = description
        self.model = copy.copy(description.model)
        # with the usual tolerance of 1e-8, differences of steps would be those of the iterations
        self.model.opt.tolerance = 1e-12
        # a state that diverges stays as it is, and is returned as NaN
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self._layout = _Layout.of(description)
        _hold_followed(self.model, self._layout)
        self._pools: dict[int, tuple[Any, list[Any]]] = {}
        self._scratch = mujoco.MjData(self.model)
        self._written: tuple[float, ...] | None = None
        self._single: Names | None = None
        self._size = mujoco.mj_stateSize(self.model, _STATE)

    def stepped(self, x: Array, u: Array, tau: Array, parameters: Mapping[str, float]) -> tuple[Array, Array]:
        """The states (B, n) after one step, and ``sensordata`` (B, s) before it; NaN where a state diverges.

        Args:
            x, u, tau: (B, n), (B, inputs), (B, forces).
            parameters: value by name.
        """
        usable = _usable(x) & _usable(u) & _usable(tau)
        states, control = self._layout.states(x, u), self._layout.control(u, tau)
        after, sensed = self._advanced(states, control[:, None], usable, parameters)
        return after[:, 0][:, self._layout.own], sensed[:, 0]

    def rolled_out(self, x: Array, u: Array, tau: Array, parameters: Mapping[str, float]) -> Array:
        """The states (T, n) after each of T steps from one state; NaN from where they diverge.

        Args:
            x, u, tau: (n,), (T, inputs), (T, forces).
            parameters: value by name.
        """
        if self._layout.followed:
            found, step, named = np.empty((len(u), len(x))), self.single(), Names(**parameters)
            state: Sequence[float] = x.tolist()
            for k, (inputs, forces) in enumerate(zip(u.tolist(), tau.tolist(), strict=True)):
                state = step(state, inputs, forces, named)
                found[k] = state
            found[np.maximum.accumulate(~_usable(found))] = np.nan
            return found
        usable = (_usable(x) & _usable(u).all() & _usable(tau).all())[None]
        return self._advanced(x[None], self._layout.control(u, tau)[None], usable, parameters)[0][0]

    def single(self) -> SingleStep:
        """A function for single steps in sequence."""
        layout, model, data = self._layout, self.model, mujoco.MjData(self.model)
        n, controls, row = layout.states_in_all, len(layout.controls), np.zeros(mujoco.mj_stateSize(model, _GIVEN))
        own, first = layout.own, n + layout.joints
        places = np.array(
            [
                *own,
                *(first + place for place in (*layout.controls, *layout.forces)),
                *layout.followed,
                *(layout.joints + k for k in layout.followed),
                *(first + layout.controls_in_all - layout.joints + k for k in layout.followed),
            ]
        )
        after, heavy = np.empty(n), layout.heavy

        def step(x: Sequence[float], u: Sequence[float], tau: Sequence[float], p: Names) -> Sequence[float]:
            if self._single is not p:  # a batch of other parameters may have been between
                self._set(vars(p))
                self._single = p
            forced = [heavy * acceleration for acceleration in u[controls + 2 :: 3]]
            row[places] = [*x, *u[:controls], *tau, *u[controls::3], *u[controls + 1 :: 3], *forced]
            mujoco.mj_setState(model, data, row, _GIVEN)
            mujoco.mj_step(model, data)
            mujoco.mj_getState(model, data, after, _MOTION)
            return after[own].tolist()

        return step

    def _advanced(self, x: Array, control: Array, usable: Mask, parameters: Mapping[str, float]) -> tuple[Array, Array]:
        """All states (B, T, n) and ``sensordata`` (B, T, s) over T steps with all controls (B, T, c)."""
        self._set(parameters)
        rows, n = len(x), x.shape[1]
        initial = np.zeros((rows, self._size))
        initial[:, 1 : 1 + n] = np.where(usable[:, None], x, 0.0)
        pool, data = self._pool
        after, sensed = pool.rollout(
            self.model,
            data,
            initial,
            np.where(usable[:, None, None], control, 0.0),
            control_spec=int(_CONTROL),
            nstep=control.shape[1],
            initial_warmstart=np.zeros((rows, self.model.nv)),
        )
        found = after[:, :, 1 : 1 + n].copy()
        found[~(usable[:, None] & _usable(found))] = np.nan
        return found, np.where(usable[:, None, None], sensed, np.nan)

    def _set(self, parameters: Mapping[str, float]) -> None:
        """Write the numbers and constants, as in the file where they are not given, and what MuJoCo derives of them.

        MuJoCo's friction depends on weights that it derives of the inertias, so that these are derived every time.
        """
        self._single = None
        numbers, known = self.description.numbers, self.description.constants
        values = (
            *(parameters[name] for name in numbers),
            *(parameters.get(name, constant.parameter.value) for name, constant in known.items()),
        )
        if values == self._written:
            return
        for number, value in zip(numbers.values(), values, strict=False):
            number.write(self.model, value)
        for constant, value in zip(known.values(), values[len(numbers) :], strict=True):
            constant.write(self.model, value, self.description.model)
        mujoco.mj_setConst(self.model, self._scratch)
        self._written = values

    @property
    def _pool(self) -> tuple[Any, list[Any]]:
        """MuJoCo's threads and their data; a forked process has none of its parent's threads, and uses its own."""
        process = os.getpid()
        if process not in self._pools:
            threads = 0 if self._pools else cores()
            # a step that fails is NaN here, and needs no message on the terminal
            mujoco.set_mju_user_warning(_silent)
            data = [mujoco.MjData(self.model) for _ in range(max(threads, 1))]
            self._pools[process] = rollout.Rollout(nthread=threads), data
        return self._pools[process]


@dataclass(frozen=True)
class _Layout:
    """Where states, inputs and forces of a simulation are among those of MuJoCo.

    Attributes:
        states_in_all: number of all states.
        controls_in_all: number of all controls, and then of all joints.
        own: place of each state.
        controls, forces: place of each input that is a control, and of each force.
        followed: number of each joint that is followed.
        joints: number of all joints.
        heavy: inertia of the joints that are followed.
    """

    states_in_all: int
    controls_in_all: int
    own: Places
    controls: list[int]
    forces: list[int]
    followed: list[int]
    joints: int
    heavy: float

    @classmethod
    def of(cls, description: Description) -> _Layout:
        whole = description.all
        joints, controls = list(whole.positions), len(whole.inputs)
        return cls(
            len(whole.states),
            controls + len(joints),
            np.array([whole.states.index(name) for name in description.states]),
            [whole.inputs.index(name) for name in description.inputs if name in whole.inputs],
            [controls + list(whole.forces).index(name) for name in description.forces],
            [joints.index(name) for name in description.followed],
            len(joints),
            _HEAVY * float(description.model.dof_M0.max()),
        )

    def states(self, x: Array, u: Array) -> Array:
        """All states (B, all), from those that are simulated and the inputs (B, u)."""
        found = np.zeros((len(x), self.states_in_all))
        found[:, self.own] = x
        moved = u[:, len(self.controls) :]
        found[:, self.followed] = moved[:, ::3]
        found[:, [self.joints + joint for joint in self.followed]] = moved[:, 1::3]
        return found

    def control(self, u: Array, tau: Array) -> Array:
        """All controls, then the forces at all joints, (B, all)."""
        found = np.zeros((len(u), self.controls_in_all))
        found[:, self.controls] = u[:, : len(self.controls)]
        found[:, self.forces] = tau
        first = self.controls_in_all - self.joints
        found[:, [first + joint for joint in self.followed]] = self.heavy * u[:, len(self.controls) + 2 :: 3]
        return found


def _hold_followed(model: mujoco.MjModel, layout: _Layout) -> None:
    """Make the joints that are followed so heavy that only the force for their recorded acceleration moves them."""
    joints = layout.followed
    model.dof_armature[joints] = layout.heavy
    model.dof_damping[joints] = 0.0
    model.dof_frictionloss[joints] = 0.0
    model.jnt_stiffness[joints] = 0.0
    model.jnt_limited[joints] = 0
    idle = [k for k in range(model.nu) if k not in layout.controls]
    model.actuator_gainprm[idle] = 0.0
    model.actuator_biasprm[idle] = 0.0
    if joints:
        mujoco.mj_setConst(model, mujoco.MjData(model))


def _silent(message: str) -> None:
    """Take a warning of MuJoCo."""


def _usable(values: Array) -> Any:
    """Whether a row is finite and not huge, so that MuJoCo takes it."""
    return (np.abs(values) < _HUGE).all(-1)
