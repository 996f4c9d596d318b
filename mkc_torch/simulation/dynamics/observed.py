"""The side of a prepared system that an observer corrects: what is predicted, what is seen, and what jumps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.simulation.dynamics.equations import Equations
from mkc_torch.simulation.dynamics.observer import Disturbance, Observer, ObserverJump
from mkc_torch.simulation.dynamics.user_functions import namespace
from mkc_torch.simulation.names import Names
from mkc_torch.simulation.own_offsets import OwnOffset
from mkc_torch.simulation.protocol import Changes

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["ObservedDynamics"]


class ObservedDynamics:
    """What a prepared system has for an observer; its attributes are those of :class:`Observable`.

    Attributes:
        kinematic: states whose rate is another state.
        clean: (N, m), the outputs with outliers smoothed away.
        inputs_at_rows: (N, u), the inputs at the samples.
        run: (N,), number of each sample's run.
    """

    system: Equations
    channels: tuple[str, ...]
    observer: Observer | None = None
    time: Tensor
    run: Tensor
    rows: Tensor
    measured: Tensor
    clean: Tensor
    inputs_at_rows: Tensor
    kinematic: Mapping[str, str]

    def parameters_of(self, theta: Tensor) -> Names:
        """The parameters of the equations by their names."""
        raise NotImplementedError

    def remembering(self, changes: Changes) -> dict[str, Mapping[str, str]]:
        """Ports at which an effect brings internal states, with these: one that adds their rates when it sees them."""
        raise NotImplementedError

    @property
    def own_offsets(self) -> tuple[OwnOffset, ...]:
        """Offsets of outputs that each recording has of its own; the last ones of the equations' parameters."""
        found: tuple[OwnOffset, ...] = getattr(self.system, "own_offsets", ())
        return found

    @property
    def pushable(self) -> tuple[str, ...]:
        """States whose rate something unrecorded can push; that of a position is its speed."""
        return tuple(name for name in self.system.states if name not in self.kinematic)

    @property
    def lasting(self) -> tuple[Disturbance, ...]:
        """What the observer follows beside the states."""
        return () if self.observer is None else self.observer.lasting

    def jump(self, theta: Tensor, changes: Changes) -> ObserverJump | None:
        """How the observer corrects the states at the samples."""
        if self.observer is None:
            return None
        n, pushes = len(self.system.states), len(self.lasting)
        memories = sum(len(memory) for memory in self.remembering(changes).values())
        places = (*range(n), *range(n + memories, n + memories + pushes))
        by_states = self.predicted(theta)

        def predict(states: Tensor) -> Tensor:
            return by_states(states) + self.pushed_outputs(states)

        return ObserverJump(self.observer, self.rows, places, self.seen(theta, changes), predict)

    def seen(self, theta: Tensor, changes: Changes) -> Float[Tensor, "N m"]:
        """The recording less what sensors and effects make of outputs: of these they may remember the earlier ones."""
        clean = dict(zip(self.channels, self.clean.unbind(-1), strict=True))
        sensor = self.system.sensor(self.time, clean, self.parameters_of(theta), self.run)
        made = torch.stack([sensor[name] - clean[name] for name in self.channels], -1)
        if "output" in changes:
            made = made + changes["output"](self.clean + made)
        return self.measured - made

    def predicted(self, theta: Tensor) -> Callable[[Tensor], Tensor]:
        """Outputs at the samples by the states there, before a sensor makes something of them."""
        n, p, u = len(self.system.states), self.parameters_of(theta), namespace(self.system.inputs, self.inputs_at_rows)

        def outputs(states: Tensor) -> Tensor:
            values = self.system.output(self.time, namespace(self.system.states, states[:, :n]), u, p)
            return torch.stack([values[name] + torch.zeros_like(states[:, 0]) for name in self.channels], -1)

        return outputs

    def pushed_outputs(self, states: Float[Tensor, "N n"]) -> Tensor:
        """What lasting disturbances add to the outputs."""
        added = [torch.zeros_like(states[:, 0]) for _ in self.channels]
        for one, push in zip(self.lasting, states[:, states.shape[1] - len(self.lasting) :].unbind(-1), strict=True):
            if not one.at_rate:
                added[self.channels.index(one.place)] = added[self.channels.index(one.place)] + push
        return torch.stack(added, -1)
