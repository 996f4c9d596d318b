"""Simulations by differential equations: a user's states, inputs, outputs and ``derivative``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.dynamics.correction import DynamicsCorrection
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics
from mkc_torch.simulation.dynamics.user_functions import check_names
from mkc_torch.simulation.parameter import Parameter, SimulationError

__all__ = ["Dynamics"]


class Dynamics:
    """A system of ordinary differential equations: give it names, parameters and a ``derivative``.

    The parameters and the first state of each experiment are fitted to the recording; the trajectory between is that
    of the differential equation alone.

    Attributes:
        states: names.
        inputs: names of the columns that drive the system.
        outputs: names of the columns that it answers to; by default those states that are columns of the recording.
        parameters: name to value to start from, or :class:`Parameter`.
        initial: of states that are not measured, a guess of their first value; default 0.
        units: of states and inputs.
        input_hold: what an input does between two samples: "held" at the earlier one, "linear", or "smooth", a polynomial
            of fifth degree through six neighbours, for signals that were sampled a few times a period.
        restart_after: in s, after which a trajectory may begin anew, for systems so unstable or chaotic that their start does
            not determine them; None for never.
        step: greatest step of the computation in s; None for what the recording's samples ask for.
        starts_from: in s, how much of each run of a new recording its first states are estimated from, so that what
            follows is a prediction; None for all of it.

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
    joins_experiments: bool = True

    def derivative(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor] | Sequence[Tensor]:
        """Rate of change of each state, by its name or in the order of ``states``.

        Args:
            time: (S,) in s.
            x: the states, each (S,), as attributes.
            u: the inputs, each (S,), as attributes.
            p: the parameters as attributes.
        """
        raise NotImplementedError(
            f"{type(self).__name__} has no `derivative(self, time, x, u, p)`; write one that returns the rate of "
            "change of each state."
        )

    def output(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor]:  # noqa: ARG002
        """What is measured, by the columns' names; by default the states themselves."""
        return vars(x)

    def actuator(self, time: Tensor, u: Any, p: Any, run: Tensor) -> Mapping[str, Tensor]:  # noqa: ARG002
        """What becomes of the inputs before they act, by their names; by default nothing.

        Args:
            time: (S,) in s, all of the recording.
            u: the inputs, each (S,), as attributes.
            p: the parameters as attributes.
            run: (S,), number of the run that each moment is of; what an actuator remembers ends with it.
        """
        return vars(u)

    def sensor(self, time: Tensor, y: Mapping[str, Tensor], p: Any, run: Tensor) -> Mapping[str, Tensor]:  # noqa: ARG002
        """What sensors make of the outputs, by the columns' names; by default nothing.

        Args:
            time: (N,) in s, all of the recording.
            y: the outputs, each (N,).
            p: the parameters as attributes.
            run: (N,), number of the run that each sample is of.
        """
        return y

    @property
    def name(self) -> str:
        return type(self).__name__

    @property
    def columns(self) -> frozenset[str]:
        return frozenset({"time", "experiment", *self.inputs, *self.outputs, *self.states})

    def prepare(self, recording: Recording) -> PreparedDynamics:
        """The simulation of a recording; its column ``experiment`` separates runs.

        Raises:
            MissingColumnError: the recording lacks ``time``, an input or an output.
            SimulationError: names that do not fit together, a ``derivative`` or ``output`` of a wrong shape or that is
                not finite, or too few samples.
        """
        check_names(self)
        outputs = self.outputs or tuple(s for s in self.states if s in recording)
        if not outputs:
            raise SimulationError(
                f"{self.name}: none of its states ({', '.join(self.states)}) is a column of the recording, which has "
                f"{', '.join(recording.names)}. Name what is measured in `outputs`."
            )
        return PreparedDynamics(self, recording.finite("time", *self.inputs, *outputs).sorted_by_time(), outputs)

    def correction(self, _state: Mapping[str, Any], recording: Recording) -> DynamicsCorrection:
        """The same with known parameters on a new recording; see :class:`mkc_torch.simulation.Correction`."""
        return DynamicsCorrection(self.prepare(recording))
