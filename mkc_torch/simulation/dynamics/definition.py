"""The base class of a user's simulation by differential equations."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

from mkc_torch.recording.join_recordings import Clock
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.dynamics.correction import DynamicsCorrection
from mkc_torch.simulation.dynamics.missing import usable_rows
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics
from mkc_torch.simulation.dynamics.steps import Steps
from mkc_torch.simulation.dynamics.user_functions import check_names
from mkc_torch.simulation.own_offsets import OwnOffset
from mkc_torch.simulation.parameter import Parameter, SimulationError

MOST = 1e100
"""Largest size of a recorded value: the squares of larger residuals, and their sums, overflow."""


class Dynamics:
    """A system of ordinary differential equations; subclasses define names, parameters and ``derivative``.

    The parameters and the initial states of each run are fitted to the recording. Within a run the trajectory follows
    the differential equations alone (open loop).

    Attributes:
        states: names of the states.
        inputs: names of the columns that drive the system.
        outputs: names of the columns that it predicts; default: the states that are columns of the recording.
        parameters: start value, or :class:`Parameter`, by name.
        initial: guess of the initial value by state, for states that are not measured; default 0.
        units: unit by state or input.
        input_hold: how inputs are interpolated between samples: "held" at the earlier sample, "linear", or "smooth",
            the polynomial of fifth degree through six samples, for signals with a few samples a period.
        restart_after: length in s of the segments that a run is split into, each with initial states of its own, for
            unstable or chaotic systems; None for whole runs.
        step: largest step of integration in s; None to choose it by the recording.
        initial_window: s from the start of each run of a new recording that the initial states are estimated from;
            later samples are predicted. None for the whole run.
        starts_as: states whose initial values in a new recording are not estimated, such as the memories of effects
            in ``corrected.py``: each starts equal to the state that it is given, or at 0 if that is empty.
        joins_experiments: whether one fit uses all runs of a recording.

    Example:
        >>> import torch
        >>> class Pendulum(Dynamics):
        ...     states = ("angle", "speed")
        ...     inputs = ("torque",)
        ...     parameters = {"stiffness": 9.0, "damping": Parameter(0.1, lower=0.0, unit="1/s")}
        ...
        ...     def derivative(self, time, x, u, p):
        ...         return {
        ...             "angle": x.speed,
        ...             "speed": u.torque - p.stiffness * torch.sin(x.angle) - p.damping * x.speed,
        ...         }
        >>> time = torch.arange(0.0, 5.0, 0.02)
        >>> recording = Recording({"time": time, "torque": 0 * time, "angle": torch.cos(3 * time)})
        >>> Pendulum().prepare(recording).parameter_names
        ('stiffness', 'damping', 'angle at the start', 'speed at the start')
    """

    states: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    parameters: Mapping[str, float | Parameter] = {}
    initial: Mapping[str, float] = {}
    units: Mapping[str, str] = {}
    input_hold: str = "linear"
    restart_after: float | None = None
    step: float | None = None
    initial_window: float | None = None
    starts_as: Mapping[str, str] = {}
    joins_experiments: bool = True
    own_offsets: tuple[OwnOffset, ...] = ()
    steps: Steps | None = None
    saved: Mapping[str, object] = {}
    measured: frozenset[str] = frozenset()

    def derivative(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor] | Sequence[Tensor]:
        """Return the rate of change of each state, by name or in the order of ``states``.

        Args:
            time: (S,), in s.
            x: the states, each (S,), as attributes.
            u: the inputs, each (S,), as attributes.
            p: the parameters as attributes.
        """
        raise NotImplementedError(
            f"{type(self).__name__} has no `derivative(self, time, x, u, p)`; define it to return the rate of "
            "change of each state."
        )

    def output(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor]:
        """Return the outputs by column name; default: the states."""
        return vars(x)

    def actuator(self, time: Tensor, u: Any, p: Any, run: Tensor) -> Mapping[str, Tensor]:
        """Return the inputs as they act on the rates and the outputs, by name; default: unchanged.

        Args:
            time: (S,), in s, of the whole recording.
            u: the inputs, each (S,), as attributes.
            p: the parameters as attributes.
            run: (S,), number of the run at each time; an actuator's memory ends with its run.
        """
        return vars(u)

    def sensor(self, time: Tensor, y: Mapping[str, Tensor], p: Any, run: Tensor) -> Mapping[str, Tensor]:
        """Return the outputs as the sensors measure them, by column name; default: unchanged.

        Args:
            time: (N,), in s, of the whole recording.
            y: the outputs, each (N,).
            p: the parameters as attributes.
            run: (N,), number of the run of each sample.
        """
        return y

    @property
    def name(self) -> str:
        return type(self).__name__

    @property
    def columns(self) -> frozenset[str]:
        return frozenset({"time", "experiment", *self.inputs, *self.outputs, *self.states})

    @property
    def joint_clock(self) -> Clock:
        return "restart" if self.joins_experiments else "follow"

    def with_restarts(self, seconds: float) -> Dynamics:
        """Return a copy whose runs are split into segments of this length in s, see ``restart_after``."""
        other = copy.copy(self)
        other.restart_after = seconds
        return other

    def prepare(self, recording: Recording) -> PreparedDynamics:
        """Prepare the simulation of a recording; the column ``experiment`` separates its runs.

        Raises:
            MissingColumnError: the recording lacks ``time``, an input or an output.
            SimulationError: inconsistent names, a ``derivative`` or ``output`` with a wrong shape or values that are
                not finite, a column beyond 1e100, or too few samples.
        """
        check_names(self)
        outputs = self.outputs or tuple(s for s in self.states if s in recording)
        if not outputs:
            raise SimulationError(
                f"{self.name}: none of its states ({', '.join(self.states)}) is a column of the recording, which has "
                f"{', '.join(recording.names)}. Name what is measured in `outputs`."
            )
        used = usable_rows(recording, self.inputs, outputs)
        for name in (*self.inputs, *outputs):
            largest = float(used[name].nan_to_num(0.0, posinf=0.0, neginf=0.0).abs().max())
            if largest > MOST:
                raise SimulationError(
                    f"{self.name}: column `{name}` reaches {largest:.3g}, but at most {MOST:g} is allowed, because "
                    "squares of larger values overflow; leave out impossible values, or choose another unit."
                )
        return PreparedDynamics(self, used, outputs)

    def correction(self, state: Mapping[str, Any], recording: Recording) -> DynamicsCorrection:
        """Prepare the simulation for a new recording; see :class:`mkc_torch.simulation.Correction`."""
        holds = {name: how for name, how in state.get("input_hold", {}).items() if name in self.inputs}
        seconds = state.get("restart_after")
        system = self if seconds is None else self.with_restarts(seconds)
        return DynamicsCorrection(system.prepare(recording).with_input_hold(holds))
