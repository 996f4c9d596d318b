"""Batches of single steps of a MuJoCo model."""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from mujoco import rollout

from mkc_torch._parallel.processes import cores
from mkc_torch.simulation.stepped.mujoco.description import Description

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
_CONTROL = mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_QFRC_APPLIED

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
        self._pools: dict[int, tuple[Any, list[Any]]] = {}
        self._constants = tuple(known.parameter.value for known in description.constants.values())
        self._size = mujoco.mj_stateSize(self.model, _STATE)

    def stepped(self, x: Array, u: Array, tau: Array, parameters: Mapping[str, float]) -> tuple[Array, Array]:
        """The states (B, n) after one step, and ``sensordata`` (B, s) before it; NaN where a state diverges.

        Args:
            x, u, tau: (B, n), (B, controls), (B, joints).
            parameters: value by name.
        """
        after, sensed = self._advanced(x, np.concatenate([u, tau], 1)[:, None], parameters)
        return after[:, 0], sensed[:, 0]

    def rolled_out(self, x: Array, u: Array, tau: Array, parameters: Mapping[str, float]) -> Array:
        """The states (T, n) after each of T steps from one state; NaN from where they diverge.

        Args:
            x, u, tau: (n,), (T, controls), (T, joints).
            parameters: value by name.
        """
        return self._advanced(x[None], np.concatenate([u, tau], 1)[None], parameters)[0][0]

    def _advanced(self, x: Array, control: Array, parameters: Mapping[str, float]) -> tuple[Array, Array]:
        """States (B, T, n) and ``sensordata`` (B, T, s) over T steps with controls (B, T, c)."""
        for name, number in self.description.numbers.items():
            number.write(self.model, parameters[name])
        self._set_constants(parameters)
        usable = _usable(x) & _usable(control).all(1)
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

    def _set_constants(self, parameters: Mapping[str, float]) -> None:
        """Write the constants, as in the file where they are not given, and what MuJoCo derives from them."""
        known = self.description.constants
        values = tuple(parameters.get(name, constant.parameter.value) for name, constant in known.items())
        if values != self._constants:
            for constant, value in zip(known.values(), values, strict=True):
                constant.write(self.model, value, self.description.model)
            mujoco.mj_setConst(self.model, mujoco.MjData(self.model))
            self._constants = values

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


def _silent(message: str) -> None:
    """Take a warning of MuJoCo."""


def _usable(values: Array) -> Any:
    """Whether a row is finite and not huge, so that MuJoCo takes it."""
    return (np.abs(values) < _HUGE).all(-1)
