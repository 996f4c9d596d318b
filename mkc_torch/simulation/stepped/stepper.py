"""The base class of a simulation that steps, in any engine.

Its states follow the map of its own steps, not a differential equation: the recurrence from sample to sample that
:mod:`mkc_torch.simulation.dynamics.trajectory` solves is that map.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.dynamics.compiled.foreign import traced_call
from mkc_torch.simulation.dynamics.definition import Dynamics
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics
from mkc_torch.simulation.dynamics.steps import Steps
from mkc_torch.simulation.foreign.function import evaluated
from mkc_torch.simulation.names import Names
from mkc_torch.simulation.parameter import Parameter, SimulationError, known_parameters
from mkc_torch.simulation.stepped.evaluation import SingleStep, StepperEvaluation

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


_UNEVEN = 0.002
"""Difference of the time between samples from whole steps, as a share, from which it is stated."""


class Stepper(Dynamics):
    """A simulation that steps; subclasses define names, parameters and ``step``, on NumPy arrays.

    Attributes:
        states: names of the states.
        inputs: names of the columns that drive the simulation; they are held from a sample to the next.
        outputs: names of the columns that it predicts; default: the states that are columns of the recording.
        positions: state that is a position, to the state that is its speed.
        forces: force that effects may add, to the state that is the speed along which it acts. A force at each joint
            acts through the simulation's own masses. Its name is free: it is no column of the recording.
        parameters: start value, or :class:`Parameter`, by name.
        constants: numbers that the simulation takes as known and effects may change, such as a payload: value, or
            :class:`Parameter`, by name. ``step`` reads them like parameters, as ``p.payload``; outside of their bounds
            it fails.
        followed: inputs that are recorded motion, such as that of a part which is not simulated; they are linear
            between samples, and effects do not act on them.
        initial: guess of the initial value by state, for states that are not measured; default 0.
        units: unit by state, input or force; the unit of a force is that of the sizes of effects there.
        time_step: length of a step in s. Samples are as many steps apart as is nearest, at least one.

    Raises:
        SimulationError: no ``time_step``, a ``step`` that returns another shape, or a recording with a column that has
            the name of a force or a constant.

    Example:
        A mass that a force accelerates, by semi-implicit Euler steps:

        >>> import numpy as np
        >>> class Mass(Stepper):
        ...     states, inputs, time_step = ("place", "speed"), ("drive",), 0.01
        ...     positions, forces = {"place": "speed"}, {"force": "speed"}
        ...     units = {"place": "m", "speed": "m/s", "drive": "N", "force": "N"}
        ...     parameters = {"mass": 2.0}
        ...
        ...     def step(self, x, u, tau, p, dt):
        ...         speed = x[:, 1] + dt * (u[:, 0] + tau[:, 0]) / p.mass
        ...         return np.stack([x[:, 0] + dt * speed, speed], 1)
        >>> time = torch.arange(0.0, 1.0, 0.02, dtype=torch.float64)
        >>> recording = Recording({"time": time, "drive": time * 0.0 + 2.0, "place": 0.5 * time**2})
        >>> Mass().prepare(recording).ports["entry of force"].unit
        'N'
    """

    positions: Mapping[str, str] = {}
    forces: Mapping[str, str] = {}
    constants: Mapping[str, float | Parameter] = {}
    followed: tuple[str, ...] = ()
    time_step: float = 0.0
    input_hold = "held"

    def step(  # type: ignore[override]
        self, x: Array, u: Array, tau: Array, p: Names, dt: float
    ) -> Array:
        """Return the states after one step.

        Args:
            x: (B, states), independent states before the step, whose next ones are computed in one call.
            u: (B, inputs), held over the step.
            tau: (B, forces), additional forces, held over the step.
            p: the parameters and the constants as attributes, a number each.
            dt: length of the step in s.

        Returns:
            (B, states); NaN where the simulation fails.
        """
        raise NotImplementedError(
            f"{type(self).__name__} has no `step(self, x, u, tau, p, dt)`; define it to return the states after one "
            "step, an array like x."
        )

    def sensed(self, x: Array, u: Array, p: Names) -> Mapping[str, Array]:
        """Return the outputs that are no states by column name, (B,) each; default: none.

        Args:
            x, u: (B, states), (B, inputs).
            p: the parameters and the constants as attributes.
        """
        return {}

    def rollout(self, x: Array, u: Array, tau: Array, p: Names, dt: float) -> Array:
        """Return the states after each of T steps from one state; a faster way than single steps may replace it.

        Args:
            x: (states,), before the first step.
            u, tau: (T, inputs), (T, forces).
            p, dt: as in ``step``.

        Returns:
            (T, states).
        """
        found = np.empty((len(u), len(x)))
        for k in range(len(u)):
            x = self.step(x[None], u[[k]], tau[[k]], p, dt)[0]
            found[k] = x
        return found

    def single(self) -> SingleStep | None:
        """Return a function for single steps in sequence that is much faster than ``step``; default: None.

        It has the states, the inputs, the forces, and the parameters and constants, and returns the next states.
        """
        return None

    @property
    def steps(self) -> Steps:  # type: ignore[override]
        alone = type(self).derivative is Stepper.derivative  # a corrected class adds to it
        constants = tuple(self.constants)
        return Steps(self.time_step, self.positions, self.forces, constants, self.followed, self._rolled_out, alone)

    @property
    def columns(self) -> frozenset[str]:
        return super().columns | frozenset(self._added)

    def derivative(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor]:
        """Return the change of the states over one step divided by its length."""
        rates = self._evaluated(False, time, x, u, p)
        return dict(zip(self._evaluation.states, rates.unbind(-1), strict=True))

    def output(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor]:
        found = dict(vars(x))
        if self._evaluation.shown:
            values = self._evaluated(True, time, x, u, p)
            found |= dict(zip(self._evaluation.shown, values.unbind(-1), strict=True))
        return found

    def prepare(self, recording: Recording) -> PreparedDynamics:
        """Prepare the simulation of a recording, see :meth:`mkc_torch.simulation.Dynamics.prepare`."""
        if not self.time_step > 0.0:
            raise SimulationError(f"{self.name}: `time_step` expected a length in s above 0, got {self.time_step!r}.")
        own = copy.copy(self)
        own.inputs = (*self._driven, *self._added)
        own.units = {**self._units_of_constants, **self.units}
        return Dynamics.prepare(own, _with_zeros(recording, self, self._added))

    @property
    def _driven(self) -> tuple[str, ...]:
        """The inputs that are columns of a recording."""
        return tuple(name for name in self.inputs if name not in self._added)

    @property
    def _added(self) -> tuple[str, ...]:
        """The inputs that only effects change: forces, and changes of constants."""
        return (*self.forces, *self.constants)

    @property
    def _units_of_constants(self) -> dict[str, str]:
        return {name: known.unit for name, known in known_parameters(self.name, self.constants).items()}

    @cached_property
    def _evaluation(self) -> StepperEvaluation:
        # a derived class, such as a corrected one, may have more states than its base steps
        base = next(kind for kind in type(self).__mro__ if "step" in vars(kind))
        states = base.states if issubclass(base, Stepper) and base.states else self.states
        known = (*states, *self._driven)
        shown = tuple(name for name in self.outputs if name not in known)
        constants = known_parameters(self.name, self.constants)
        return StepperEvaluation(self, states, self._driven, tuple(self.parameters), shown, constants)

    def _rolled_out(self, state: Tensor, inputs: Tensor, p: Any) -> Tensor:
        """The states after each step, as a tensor."""
        m = len(self._driven)
        given, known = inputs.detach().cpu().numpy(), {name: float(value) for name, value in vars(p).items()}
        x, forces = state[0].detach().cpu().numpy(), slice(m, m + len(self.forces))
        x, more = np.split(x, [len(self._evaluation.states)])  # internal states of effects have no steps of their own
        changed = self._evaluation.changed(given[0, forces.stop :]) if len(given) else {}
        if changed is None:
            return inputs.new_full((len(given), len(state[0])), torch.nan)
        named = Names(**known, **changed)
        with np.errstate(over="ignore", invalid="ignore"):  # where the simulation diverges
            found = self.rollout(x, given[:, :m], given[:, forces], named, self.time_step)
        return torch.from_numpy(np.concatenate([found, np.tile(more, (len(found), 1))], 1)).to(state)

    def _evaluated(self, outputs: bool, time: Tensor, x: Any, u: Any, p: Any) -> Tensor:
        evaluation, given = self._evaluation, vars(u)
        own = torch.broadcast_tensors(*(getattr(x, name) for name in evaluation.states))
        rows = len(own[0])
        columns = [given[name].expand(rows) for name in evaluation.inputs]
        # forces and changes of constants are 0 for a caller that has none
        columns += [given[name].expand(rows) if name in given else own[0].new_zeros(rows) for name in self._added]
        known = [getattr(p, name) for name in evaluation.parameters]
        traced = traced_call(evaluation, outputs, time.expand(rows), own, columns, known)
        if traced is not None:
            return traced
        states = torch.stack(own, -1)
        inputs = torch.stack(columns, -1) if columns else states.new_zeros(rows, 0)
        parameters = torch.stack(known) if known else states.new_zeros(0)
        return evaluated(evaluation, outputs, time.expand(rows), states, inputs, parameters)


def _with_zeros(recording: Recording, stepper: Stepper, names: Sequence[str]) -> Recording:
    """The recording with a column of zeros for each force and each constant."""
    # a prepared recording has them already
    taken = [name for name in names if name in recording and bool((recording[name] != 0.0).any())]
    if taken:
        raise SimulationError(
            f"{stepper.name}: the recording has a column `{taken[0]}`, the name of a force or a constant at which "
            "effects act; rename the column, or make the recorded quantity an input."
        )
    zeros = {name: torch.zeros(len(recording), dtype=torch.float64) for name in names}
    units = {name: stepper.units[name] for name in names if name in stepper.units}
    return Recording(
        {**recording.columns, **zeros},
        name=recording.name,
        units={**recording.units, **units},
        warnings=recording.warnings,
        labels=recording.labels,
        notes=(*recording.notes, *_about_steps(recording, stepper)),
    )


def _about_steps(recording: Recording, stepper: Stepper) -> tuple[str, ...]:
    """A sentence where the samples are no whole number of steps apart; empty where they are."""
    gaps = recording["time"].diff() if "time" in recording else torch.zeros(0)
    gaps = gaps[gaps > 0]
    if not len(gaps):
        return ()
    sample = float(gaps.median())
    steps = max(round(sample / stepper.time_step), 1)
    if abs(sample - steps * stepper.time_step) <= _UNEVEN * sample:
        return ()
    return (
        f"Samples are {sample:.4g} s apart, and a step of {stepper.name} lasts {stepper.time_step:.4g} s: for each "
        f"sample {several_steps(steps)} taken, as if they lasted {sample / steps:.4g} s each.",
    )


def several_steps(count: int) -> str:
    """The number of steps with its verb.

    Example:
        >>> several_steps(1), several_steps(4)
        ('1 step is', '4 steps are')
    """
    return "1 step is" if count == 1 else f"{count} steps are"
