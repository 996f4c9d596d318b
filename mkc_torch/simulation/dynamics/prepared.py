"""A system of differential equations prepared with a recording."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mkc_torch._support.dual_constants import dual_constants
from mkc_torch._support.torch_internals import is_wrapped
from mkc_torch.nonlinear import load_forward_mode
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.continuation import Meaning, is_plain
from mkc_torch.simulation.dynamics.between_samples import inputs_between
from mkc_torch.simulation.dynamics.checked import AT_START, CheckedDynamics
from mkc_torch.simulation.dynamics.checks import SampledStates, check_functions
from mkc_torch.simulation.dynamics.compiled.faithful import is_faithful
from mkc_torch.simulation.dynamics.compiled.residual import CompiledDynamics, compiled_dynamics
from mkc_torch.simulation.dynamics.entering import entered, over_a_step
from mkc_torch.simulation.dynamics.equations import Equations
from mkc_torch.simulation.dynamics.first_guess import despiked, first_guess
from mkc_torch.simulation.dynamics.first_parameters import first_parameters
from mkc_torch.simulation.dynamics.layout import InputRows, lay_out
from mkc_torch.simulation.dynamics.missing import MissingOutputs, with_lines
from mkc_torch.simulation.dynamics.observer import Observer
from mkc_torch.simulation.dynamics.own_offsets import equations_with_offsets
from mkc_torch.simulation.dynamics.ports import ENTRIES, RATES, PortContext, common_unit
from mkc_torch.simulation.dynamics.prior import prior_of
from mkc_torch.simulation.dynamics.refinement import FINEST, enough_parts
from mkc_torch.simulation.dynamics.rollout import rolled_out, rolls_out
from mkc_torch.simulation.dynamics.segments import beginnings, refuse_few
from mkc_torch.simulation.dynamics.settings import HORIZON
from mkc_torch.simulation.dynamics.single_outputs import with_changes
from mkc_torch.simulation.dynamics.steps import port_of
from mkc_torch.simulation.dynamics.trajectory import Trajectory, marched, solve, stations
from mkc_torch.simulation.dynamics.user_functions import kinematic, namespace
from mkc_torch.simulation.dynamics.varying import Acting
from mkc_torch.simulation.parameter import known_parameters
from mkc_torch.simulation.ports import Answer, Changes, Nearby, Port
from mkc_torch.simulation.runs import experiment_runs

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_PATIENT = 2
"""Stride of the growing horizon, in grid times, for trajectories that are hard to solve."""


class PreparedDynamics(CheckedDynamics):
    """A system of differential equations with its recording; implements the protocol of a prepared simulation.

    Attributes:
        recordings: names of the recordings that are diagnosed together; empty for a single recording.
        of_run: (K,), number of the recording of each run; empty for a single recording.
    """

    recordings: tuple[str, ...] = ()
    of_run: Int[Tensor, " K"] = torch.zeros(0, dtype=torch.long)

    def __init__(self, system: Equations, recording: Recording, outputs: tuple[str, ...]) -> None:
        self.system, self.whole, self.channels = system, recording, outputs
        self.name = system.name
        known = recording.stack(*outputs).isfinite()
        sampled = known.any(-1)
        samples = recording.rows(sampled)
        self.time = samples["time"]
        self.begins, self.labels = beginnings(samples, system)
        self.missing = MissingOutputs.of(known[sampled], self.time, self.begins)
        values = samples.stack(*outputs)
        self.measured = values if self.missing is None else self.missing.replaced(values)
        self.recording = with_lines(samples, outputs, self.begins)
        self.unit = common_unit(system.units.get(name, recording.units[name]) for name in outputs)
        self.independent = (True,) * len(outputs)
        self.known = known_parameters(system.name, system.parameters)
        self.run = experiment_runs(self.recording)
        self.known_inputs = InputRows.of(recording, system.inputs, sampled, self.begins)
        self.inputs_at_rows = self.known_inputs.inputs[self.known_inputs.samples]
        # a simulation that steps holds its inputs over each step; there is no choice
        self.input_hold = dict.fromkeys(system.inputs, system.input_hold) if system.steps is None else {}
        refuse_few(self.begins, system.name)
        self.kinematic = kinematic(system, self.known)
        self._lay_out(1)
        starts = [f"{state} at the start{label}" for label in self.labels for state in system.states]
        self.parameter_names = (*self.known, *starts)
        low = [parameter.lower for parameter in self.known.values()]
        high = [parameter.upper for parameter in self.known.values()]
        any_value = [torch.inf] * len(starts)
        self.bounds = self.time.new_tensor([*low, *(-x for x in any_value)]), self.time.new_tensor(high + any_value)
        self.prior = prior_of(list(self.known.values()), len(starts))
        self.clean = torch.stack([despiked(self.recording[name], self.time, self.begins) for name in outputs], -1)
        self.counts = self.clean == self.measured
        if self.missing is not None:
            self.counts = self.counts & self.missing.recorded
        self._faithful: dict[int, bool] = {}
        self._check_functions()
        self._refine()

    def _lay_out(self, parts: int) -> None:
        """Set up the grid with this many intervals between rows, and everything that depends on the grid."""
        size = None if self.system.steps is None else self.system.steps.size
        found, self.parts = lay_out(self.known_inputs, parts, size), parts
        self.grid, self.rows, self.clock, self._input_clock = found.grid, found.rows, found.clock, found.input_clock
        self.inputs = self._between(self.known_inputs.inputs)
        self.guess = first_guess(
            self.system,
            self.recording,
            self.channels,
            self.begins,
            self.kinematic,
            found.grid.time,
            found.before,
            found.share,
        )
        self.__dict__.pop("ports", None)  # their clock has the times of the stations

    def _between(self, inputs: Float[Tensor, "R u"]) -> Float[Tensor, "S u"]:
        """Inputs at the stations."""
        known = self.known_inputs
        holds = dict.fromkeys(self.system.inputs, self.system.input_hold) | self.input_hold
        holds |= dict.fromkeys(() if self.system.steps is None else self.system.steps.followed, "linear")
        columns = [
            inputs_between(inputs[:, [k]], how, known.time, known.begins, self._input_clock)
            for k, how in enumerate(holds.values())
        ]
        return torch.cat(columns, -1) if columns else inputs.new_zeros(len(self.clock.time), 0)

    @property
    def state(self) -> Mapping[str, object]:
        """The measured outputs, and the inputs' holds and the restarts, which a diagnosis may have chosen."""
        holds = {"input_hold": dict(self.input_hold)} if self.input_hold else {}
        seconds = self.system.restart_after
        restarts = {} if seconds is None else {"restart_after": seconds}
        return {"class": self.system.name, "outputs": list(self.channels), **self.system.saved, **holds, **restarts}

    def with_input_hold(self, between: Mapping[str, str]) -> PreparedDynamics:
        """The simulation with other input interpolation, "held", "linear" or "smooth", by input name."""
        other = copy.copy(self)
        other.input_hold = {**self.input_hold, **between}
        other.inputs = other._between(self.known_inputs.inputs)
        for known in AT_START:
            other.__dict__.pop(known, None)
        return other

    def finer(self) -> PreparedDynamics | None:
        """The simulation with half the integration step; None where the user set the step, or it is the smallest."""
        if self.system.step is not None or self.system.steps is not None or 2 * self.parts > FINEST:
            return None
        other = copy.copy(self)
        other._lay_out(2 * self.parts)
        for known in AT_START:
            other.__dict__.pop(known, None)
        return other

    def guessed(self, near: Nearby | None) -> PreparedDynamics:
        """The simulation with a trajectory's states as its guess, so that unmeasured states have a size."""
        if not isinstance(near, Trajectory):
            return self
        other = copy.copy(self)
        other.guess = near.states[:, : len(self.system.states)]
        other.__dict__.pop("ports", None)
        return other

    def observed(self, observer: Observer | None) -> PreparedDynamics:
        """The simulation corrected by an observer; None for the open loop."""
        if observer is self.observer:
            return self
        other = copy.copy(self)
        other.observer = observer
        return other

    @property
    def dynamics(self) -> PreparedDynamics:
        return self

    def open_loop(self) -> PreparedDynamics:
        return self.observed(None)

    def with_own_offsets(self, recording: Int[Tensor, " N"], names: Sequence[str]) -> PreparedDynamics:
        load_forward_mode()
        theta = self.start()
        near = self.trajectory(theta, {})
        tangents = torch.func.jacfwd(dual_constants(lambda values: self.residual(values, {}, near)))(theta)
        system = equations_with_offsets(self.system, self.channels, self.run, tangents, recording, names)
        other = copy.copy(self) if system is None else PreparedDynamics(system, self.whole, self.channels)
        other.recordings = tuple(names)
        other.of_run = recording.new_zeros(int(self.run.max()) + 1).scatter(0, self.run, recording)
        return other

    @cached_property
    def ports(self) -> dict[str, Port]:
        """The ports: rates, exchanges, inputs, their entries, parameters, and the outputs."""
        places = PortContext(
            self.system,
            self.recording,
            self.channels,
            self.known,
            self.kinematic,
            self.guess[self.rows],
            self.clock,
            self.run,
        )
        return places.ports()

    def start(self, rows: Bool[Tensor, " N"] | None = None) -> Float[Tensor, " p"]:
        return self.observed(None)._start.clone()

    @cached_property
    def _start(self) -> Float[Tensor, " p"]:
        def rate(theta: Tensor) -> Callable[[Tensor], Tensor]:
            return self.rate(theta, {})

        residual = partial(self.residual, changes={})
        return first_parameters(self.given, self.bounds, len(self.known), rate, self.guess, self.grid, residual)

    def answer(self, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None = None) -> Answer:
        """The residual and the trajectory; see :meth:`mkc_torch.simulation.PreparedSimulation.answer`."""
        found = self.trajectory(theta, changes, near)
        # a tensor of a transform must not outlive it
        lasting = found.converged and not is_wrapped(found.states)
        nearby = replace(found, states=found.states.detach()) if lasting else None
        return Answer(self._residual(theta, changes, found), nearby)

    def compiled(self, meaning: Meaning, size: int) -> CompiledDynamics | None:
        """The residual as a function of ``size`` parameters, computed without torch; None where it cannot be traced.

        Args:
            meaning: maps these parameters to the simulation's own parameters and the changes at its ports.
            size: number of parameters.
        """
        stations = len(self.clock.time)
        if stations not in self._faithful:  # shared by copies, whose functions are the same
            self._faithful[stations] = is_faithful(self.observed(None), self.given)
        return compiled_dynamics(self, meaning, size) if self._faithful[stations] else None

    def residual(
        self, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None = None
    ) -> Float[Tensor, "N m"]:
        """The residual of :meth:`answer`."""
        return self._residual(theta, changes, self.trajectory(theta, changes, near))

    def _residual(self, theta: Tensor, changes: Changes, found: Trajectory) -> Float[Tensor, "N m"]:
        left = self.measured - self._simulated(theta, changes, found)
        left = left if self.missing is None else self.missing.left_out(left)
        left = left if self.observer is None else self.observer.whitened(left)
        return left if self.missing is None else self.missing.replaced(left)

    def simulated(
        self, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None = None
    ) -> Float[Tensor, "N m"]:
        """The outputs at the samples, (N, m); NaN where no trajectory is found."""
        return self._simulated(theta, changes, self.trajectory(theta, changes, near))

    def _simulated(self, theta: Tensor, changes: Changes, found: Trajectory) -> Float[Tensor, "N m"]:
        outputs = self.outputs_by_states(theta, changes, found.states[self.rows])
        return outputs if found.converged else outputs * torch.nan

    def outputs_by_states(
        self,
        theta: Float[Tensor, " p"],
        changes: Changes,
        states: Float[Tensor, "N w"],
        acting: Acting | None = None,
    ) -> Float[Tensor, "N m"]:
        """The outputs at the samples from the states there, including internal states of effects and disturbances.

        ``acting`` are the acting inputs and parameters at the samples if they are known.
        """
        outputs = self._outputs(self.acting_at_samples(theta, changes) if acting is None else acting, changes, states)
        if "output" in changes:
            outputs = outputs + changes["output"](outputs)
        return outputs + self.output_disturbance(states)

    def signals(self, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None = None) -> Mapping[str, Tensor]:
        found = self.trajectory(theta, changes, near)
        acting = self.acting(theta, changes)
        jump = self.jump(theta, changes)
        at_stations = stations(self.rate(theta, changes, acting), found.states, self.grid, jump)
        at_stations = at_stations[:, : len(self.system.states)]
        here, at_samples = self.acting_at_samples(theta, changes), found.states[self.rows]
        outputs, plain = self._outputs(here, changes, at_samples), self.predicted(here, {})(at_samples)
        rates = self._rates(entered(self.ports, self.system.inputs, acting, at_stations, changes)[0], at_stations)
        at = {
            name: self._signal(port, acting, at_stations, rates)
            for name, port in self.ports.items()
            if port.kind in (*RATES, *ENTRIES)
        }
        at |= {port_of(self.system.steps, name): self.inputs[:, [k]] for k, name in enumerate(self.system.inputs)}
        still = torch.zeros_like(self.clock.time).unsqueeze(-1)
        p = self.parameters_of(theta)
        varying = [port.channels[0] for port in self.ports.values() if port.kind == "parameter"]
        at |= {f"parameter {name}": getattr(p, name) + still for name in varying}
        at |= {f"output {name}": plain[:, [k]] for k, name in enumerate(self.channels)}
        return at | {"output": outputs}

    def trajectory(
        self, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None = None, *, patient: bool = False
    ) -> Trajectory:
        """Solve for the states at all grid times, with the changes by effects.

        Args:
            theta: (p,), the parameters.
            changes: the changes by effects, by port.
            near: a trajectory at parameters nearby to start from; None to start from the guess.
            patient: whether to fall back to a horizon that grows in small strides.
        """
        rate, jump = self.rate(theta, changes), self.jump(theta, changes)
        begin, memories = self.first_states(theta, changes)
        width = begin.shape[1]
        if rolls_out(self, theta, changes):
            found = rolled_out(self, rate, theta, changes, begin)
            if found.converged:
                return found
        known = near if isinstance(near, Trajectory) else None
        guess = self.with_memories(self.guess if known is None else known.states, memories)
        linear = known is not None and known.linear is not None and known.states.shape[1] == width
        found = solve(rate, self.grid, begin, guess, known if linear else None, jump=jump)
        if not found.converged and self.system.steps is not None and jump is None:
            # a fit shortens its step where this fails; step by step would be dear
            return rolled_out(self, rate, theta, changes, begin) if known is None and is_plain(theta) else found
        if not found.converged and known is not None:
            found = solve(rate, self.grid, begin, self.with_memories(self.guess, memories), jump=jump)
        if not found.converged and known is None:
            nearer = self._marched(theta, changes, guess, HORIZON)
            found = found if nearer is None else solve(rate, self.grid, begin, nearer, jump=jump)
        if not found.converged and patient:
            nearer = self._marched(theta, changes, guess, _PATIENT)
            found = found if nearer is None else solve(rate, self.grid, begin, nearer, jump=jump)
        return found

    def _marched(
        self, theta: Tensor, changes: Changes, guess: Float[Tensor, "G w"], stride: int
    ) -> Float[Tensor, "G w"] | None:
        """Improve a guess by solving over a growing horizon; None where that fails."""
        compiled = self.compiled(lambda parameters: (parameters, changes), len(theta)) if is_plain(theta) else None
        if compiled is not None:
            return compiled.marched(theta, guess, stride)
        rate, jump = self.rate(theta, changes), self.jump(theta, changes)
        return marched(rate, self.grid, self.first_states(theta, changes)[0], guess, stride=stride, jump=jump)

    def first_states(self, theta: Float[Tensor, " p"], changes: Changes) -> tuple[Float[Tensor, "K w"], list[str]]:
        """Initial states of the runs, with internal states, and the state that each internal state starts equal to."""
        memories = [like for memory in self.remembering(changes).values() for like in memory.values()]
        memories += [""] * len(self.lasting)
        begin = theta[len(self.known) :].unflatten(0, (-1, len(self.system.states)))
        return self.with_memories(begin, memories), memories

    def rate(self, theta: Tensor, changes: Changes, acting: Acting | None = None) -> Callable[[Tensor], Tensor]:
        """The function for the rates of the states, the effects' internal states and the lasting disturbances.

        ``acting`` are the acting inputs and parameters at the stations if they are known.
        """
        now = self.acting(theta, changes) if acting is None else acting
        remembering = self.remembering(changes)
        rows = [*self.system.states, *(name for memory in remembering.values() for name in memory)]
        lasting, n = self.lasting, len(self.system.states)
        held_at = {name: [rows.index(row) for row in memory] for name, memory in remembering.items()}
        added_at = [
            (port, [rows.index(row) for row in (*port.channels, *remembering.get(name, ()))], name)
            for name, port in self.ports.items()
            if port.kind in RATES and name in changes
        ]

        def rate(states: Tensor) -> Tensor:
            own, memories, disturbances = states.split([n, len(rows) - n, len(lasting)], -1)
            held = {name: states[:, places] for name, places in held_at.items()}
            driven, of_memories = entered(self.ports, self.system.inputs, now, own, changes, held)
            plain = self._rates(driven, own)
            rates = [*plain, *(torch.zeros_like(memory) for memory in memories.unbind(-1))]
            for name, found in of_memories.items():
                for k, added in zip(
                    held_at[name], over_a_step(self.ports[name], found, plain, self.system), strict=True
                ):
                    rates[k] = added
            for port, places, name in added_at:
                signal = self._signal(port, now, own, plain)
                if name in remembering:
                    signal = torch.cat([signal, states[:, places[len(port.channels) :]]], -1)
                for k, added in zip(places, changes[name](signal).unbind(-1), strict=True):
                    rates[k] = rates[k] + added
            for disturbance, value in zip(lasting, disturbances.unbind(-1), strict=True):
                if disturbance.at_rate:
                    rates[rows.index(disturbance.place)] = rates[rows.index(disturbance.place)] + value
                rates.append(-value / disturbance.lasting)
            return torch.stack(rates, -1)

        return rate

    def _rates(self, acting: Acting, states: Tensor) -> list[Tensor]:
        """Rates of the states by the simulation's own equations."""
        return self._derivative(
            self.clock.time, states, namespace(self.system.inputs, acting.inputs), acting.parameters
        )

    def _signal(self, port: Port, acting: Acting, states: Tensor, rates: Sequence[Tensor]) -> Float[Tensor, "S k"]:
        """Signal at a rate port: the states and inputs, then the rate or the load where the port has it."""
        own, inputs, p = self.system.states.index(port.parts["own"]), *acting
        if "rate" in port.parts:
            return torch.cat([states, inputs, rates[own].unsqueeze(-1)], -1)
        if "load" not in port.parts:
            return torch.cat([states, inputs], -1)
        idle = namespace(self.system.inputs, torch.zeros_like(inputs))
        at_rest = torch.cat([states[:, :own], torch.zeros_like(states[:, [own]]), states[:, own + 1 :]], -1)
        coasting, held = (self._derivative(self.clock.time, x, idle, p)[own] for x in (states, at_rest))
        load = (rates[own] - coasting - held).abs().unsqueeze(-1)  # of the drive against the holding forces
        return torch.cat([states, inputs, load], -1)

    def _derivative(self, time: Tensor, states: Tensor, u: Any, p: Any) -> list[Tensor]:
        found = self.system.derivative(time, namespace(self.system.states, states), u, p)
        values = [found[s] for s in self.system.states] if isinstance(found, Mapping) else list(found)
        return [v + torch.zeros_like(states[:, 0]) for v in values]

    def _outputs(self, acting: Acting, changes: Changes, states: Float[Tensor, "N w"]) -> Float[Tensor, "N m"]:
        inputs, p = acting
        x = namespace(self.system.states, states[:, : len(self.system.states)])
        u = namespace(self.system.inputs, inputs)
        y = with_changes(self.system.output(self.time, x, u, p), changes, states[:, 0])
        values = self.system.sensor(self.time, y, p, self.run)
        return torch.stack([values[name] for name in self.channels], -1)

    def _check_functions(self) -> None:
        theta = self.time.new_tensor([parameter.value for parameter in self.known.values()])
        at = self.grid.spread(self.guess)
        first = at[:1].expand(len(self.time), -1)
        stations = SampledStates(self.clock.time, at, self.inputs, self.run[self.clock.before])
        samples = SampledStates(self.time, first, self.inputs_at_rows, self.run)
        check_functions(self.system, self.parameters_of(theta), stations, samples, self.channels)

    def _refine(self) -> None:
        """Set the number of intervals between samples: by the user's step, or until doubling changes nothing."""
        if self.system.steps is not None:
            return
        if self.system.step is not None:
            inside = self.known_inputs.time.diff()[~self.known_inputs.begins[1:]]
            self._lay_out(max(1, int(torch.ceil(inside.max() / self.system.step - 1e-9))))
            return
        theta = self.start()

        def simulated(parts: int) -> Tensor:
            if parts > 1:
                self._lay_out(parts)
            return self.simulated(theta, {})

        self._lay_out(enough_parts(simulated, self.measured))
