"""The part of a prepared system that an observer uses: predicted outputs, measured outputs, and corrections."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from mkc_torch.nonlinear import GaussianPrior
from mkc_torch.simulation.dynamics.equations import Equations
from mkc_torch.simulation.dynamics.missing import MissingOutputs
from mkc_torch.simulation.dynamics.observer import Disturbance, Observer, ObserverJump
from mkc_torch.simulation.dynamics.single_outputs import with_changes
from mkc_torch.simulation.dynamics.steps import port_of
from mkc_torch.simulation.dynamics.trajectory import Grid
from mkc_torch.simulation.dynamics.user_functions import namespace
from mkc_torch.simulation.dynamics.varying import Acting, varied
from mkc_torch.simulation.names import Names
from mkc_torch.simulation.own_offsets import OwnOffset
from mkc_torch.simulation.parameter import Parameter
from mkc_torch.simulation.ports import Changes, FreeChange, Port, SignalTimes

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


class ObservedDynamics:
    """Base class of a prepared system for use with an observer; further attributes as in :class:`Observable`.

    Attributes:
        kinematic: state whose rate is another state, to that state.
        missing: where outputs are missing; None where none is.
        clean: (N, m), the measured outputs with outliers replaced.
        inputs: (S, u), the inputs at the stations.
        inputs_at_rows: (N, u), the inputs at the samples.
        run: (N,), number of each sample's run.
    """

    system: Equations
    channels: tuple[str, ...]
    observer: Observer | None = None
    grid: Grid
    time: Tensor
    run: Tensor
    rows: Tensor
    measured: Tensor
    missing: MissingOutputs | None
    clean: Tensor
    inputs: Tensor
    inputs_at_rows: Tensor
    kinematic: Mapping[str, str]
    known: Mapping[str, Parameter]
    guess: Tensor
    clock: SignalTimes
    begins: Tensor
    parameter_names: tuple[str, ...]

    @property
    def ports(self) -> Mapping[str, Port]:
        """The ports at which effects act."""
        raise NotImplementedError

    @property
    def recorded(self) -> Bool[Tensor, "N m"] | None:
        """Mask of the samples with a recorded output; None where no output is missing."""
        return None if self.missing is None else self.missing.recorded

    prior: GaussianPrior | None = None
    faults: tuple[str, ...] = ()

    @property
    def jacobian(self) -> Literal["forward", "reverse twice"]:
        """A user's equations are many small operations, and a simulation that steps is a single large operation."""
        return "reverse twice" if self.system.steps is None else "forward"

    def parameters_of(self, theta: Tensor) -> Names:
        """The parameters of the equations by name."""
        return Names(**dict(zip(self.known, theta[: len(self.known)].unbind(), strict=True)))

    def acting(self, theta: Tensor, changes: Changes) -> Acting:
        """The inputs and the parameters at the stations, with effects and the actuator."""
        return Acting(self.acting_inputs(theta, changes), self.acting_parameters(theta, changes))

    def acting_at_samples(self, theta: Tensor, changes: Changes) -> Acting:
        """The inputs and the parameters at the samples, with effects and the actuator if an output depends on them."""
        return Acting(self.inputs_at_samples(theta, changes), self.parameters_at_samples(theta, changes))

    def acting_parameters(self, theta: Tensor, changes: Changes) -> Names:
        """The parameters at the stations by name; a number where no effect changes it."""
        p = self.parameters_of(theta)
        return Names(**{**vars(p), **varied(p, changes, self.clock.time)})

    def parameters_at_samples(self, theta: Tensor, changes: Changes) -> Names:
        """The parameters at the samples by name; a number where no effect changes it."""
        p = self.parameters_of(theta)
        changed = varied(p, changes, self.clock.time)
        return Names(**{**vars(p), **{name: values[self._stations_of_samples] for name, values in changed.items()}})

    @property
    def _stations_of_samples(self) -> Tensor:
        """The station at each sample: the last one at the end, elsewhere the first of the interval that begins."""
        return (self.grid.per_interval * self.rows).clamp(max=len(self.clock.time) - 1)

    def acting_inputs(self, theta: Tensor, changes: Changes) -> Float[Tensor, "S u"]:
        """The inputs at the stations, with effects and the actuator."""
        if not self.system.inputs:
            return self.inputs
        columns = {
            name: self.inputs[:, k] + changes[port](self.inputs[:, [k]])[:, 0]
            if (port := port_of(self.system.steps, name)) in changes
            else self.inputs[:, k]
            for k, name in enumerate(self.system.inputs)
        }
        run = self.run[self.clock.before]
        acting = self.system.actuator(self.clock.time, Names(**columns), self.acting_parameters(theta, changes), run)
        return torch.stack([acting[name] for name in self.system.inputs], -1)

    def inputs_at_samples(self, theta: Tensor, changes: Changes) -> Float[Tensor, "N u"]:
        """The inputs at the samples, with effects and the actuator if an output depends on them."""
        if not self.acts_on_outputs(changes):
            return self.inputs_at_rows
        added = self.acting_inputs(theta, changes) - self.inputs
        return self.inputs_at_rows + added[self._stations_of_samples]

    def acts_on_outputs(self, changes: Changes) -> bool:
        """Whether an output depends on an input directly, and an effect or the actuator changes an input."""
        changed = any(port_of(self.system.steps, name) in changes for name in self.system.inputs)
        return (changed or self._has_actuator) and self._feeds_through

    @cached_property
    def _has_actuator(self) -> bool:
        p = self.parameters_of(self.time.new_tensor([parameter.value for parameter in self.known.values()]))
        u = Names(**dict(zip(self.system.inputs, self.inputs.unbind(-1), strict=True)))
        acting = self.system.actuator(self.clock.time, u, p, self.run[self.clock.before])
        return any(acting[name] is not getattr(u, name) for name in self.system.inputs)

    @cached_property
    def _feeds_through(self) -> bool:
        """Whether an output depends on an input directly, and not only on the states."""
        p = self.parameters_of(self.time.new_tensor([parameter.value for parameter in self.known.values()]))
        x = namespace(self.system.states, self.guess[self.rows])
        moved = self.inputs_at_rows + self.inputs_at_rows.abs().amax(0, keepdim=True) + 1.0
        found = [
            self.system.output(self.time, x, namespace(self.system.inputs, u), p) for u in (self.inputs_at_rows, moved)
        ]
        return any(not torch.equal(found[0][name], found[1][name]) for name in self.channels)

    def remembering(self, changes: Changes) -> dict[str, Mapping[str, str]]:
        """Ports whose effect has internal states, and these states.

        An effect has them if it returns their rates too when its signal contains them.
        """
        found = {}
        for name, port in self.ports.items():
            # a change that does not depend on the signal has no memory
            if port.memory and name in changes and not isinstance(changes[name], FreeChange):
                seen = self.guess.new_zeros(len(self.clock.time), len(port.carries) + len(port.memory))
                if changes[name](seen).shape[1] > len(port.channels):
                    found[name] = port.memory
        return found

    def with_memories(self, states: Float[Tensor, "G n"], memories: Sequence[str]) -> Float[Tensor, "G w"]:
        """The states with missing internal states appended, equal to another state or 0."""
        n = len(self.system.states)
        more = [
            states[:, self.system.states.index(like)] if like else states.new_zeros(len(states))
            for like in memories[states.shape[1] - n :]
        ]
        return torch.cat([states[:, : n + len(memories)], *(column.unsqueeze(-1) for column in more)], -1)

    def time_since_start(self) -> Float[Tensor, " N"]:
        """Time since the start of each sample's run, in s."""
        first = torch.where(self.begins, torch.arange(len(self.time)), 0).cummax(0).values
        return self.time - self.time[first]

    @property
    def beginnings(self) -> int:
        """Number of parameters of single runs or recordings: offsets and initial states; they come last."""
        return len(self.parameter_names) - len(self.known) + len(self.own_offsets)

    def prior_given(self, settled: Collection[str]) -> GaussianPrior | None:
        """The prior, which no effect changes."""
        return self.prior

    @property
    def own_offsets(self) -> tuple[OwnOffset, ...]:
        """Offsets of outputs in single recordings; they are the last of the equations' parameters."""
        return self.system.own_offsets

    @property
    def disturbable(self) -> tuple[str, ...]:
        """States whose rate process noise can act on; the rate of a position is its speed and has none."""
        return tuple(name for name in self.system.states if name not in self.kinematic)

    @property
    def lasting(self) -> tuple[Disturbance, ...]:
        """Lasting disturbances that the observer estimates in addition to the states."""
        return () if self.observer is None else self.observer.lasting

    def jump(self, theta: Tensor, changes: Changes, acting: Acting | None = None) -> ObserverJump | None:
        """Correction of the states by the observer at the samples; None in open loop.

        ``acting`` are the acting inputs and parameters at the samples if they are known.
        """
        if self.observer is None:
            return None
        n, extra = len(self.system.states), len(self.lasting)
        memories = sum(len(memory) for memory in self.remembering(changes).values())
        places = (*range(n), *range(n + memories, n + memories + extra))
        by_states = self.predicted(self.acting_at_samples(theta, changes) if acting is None else acting, changes)

        def predict(states: Tensor) -> Tensor:
            return by_states(states) + self.output_disturbance(states)

        return ObserverJump(self.observer, self.rows, places, self.seen(theta, changes), predict)

    def seen(self, theta: Tensor, changes: Changes) -> Float[Tensor, "N m"]:
        """The recording minus the contributions of sensors and output effects, which may depend on earlier outputs."""
        clean = dict(zip(self.channels, self.clean.unbind(-1), strict=True))
        sensor = self.system.sensor(self.time, clean, self.parameters_of(theta), self.run)
        made = torch.stack([sensor[name] - clean[name] for name in self.channels], -1)
        if "output" in changes:
            made = made + changes["output"](self.clean + made)
        return self.measured - made

    def predicted(self, acting: Acting, changes: Changes) -> Callable[[Tensor], Tensor]:
        """The function from the states at the samples to the outputs there, with effects, before the sensors."""
        n, p = len(self.system.states), acting.parameters
        u = namespace(self.system.inputs, acting.inputs)

        def outputs(states: Tensor) -> Tensor:
            plain = self.system.output(self.time, namespace(self.system.states, states[:, :n]), u, p)
            values = with_changes(plain, changes, states[:, 0])
            return torch.stack([values[name] + torch.zeros_like(states[:, 0]) for name in self.channels], -1)

        return outputs

    def output_disturbance(self, states: Float[Tensor, "N n"]) -> Tensor:
        """Contribution of the lasting disturbances to the outputs, (N, m)."""
        added = [torch.zeros_like(states[:, 0]) for _ in self.channels]
        for disturbance, value in zip(
            self.lasting, states[:, states.shape[1] - len(self.lasting) :].unbind(-1), strict=True
        ):
            if not disturbance.at_rate:
                added[self.channels.index(disturbance.place)] = added[self.channels.index(disturbance.place)] + value
        return torch.stack(added, -1)
