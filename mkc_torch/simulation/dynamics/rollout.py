"""The plain rollout of a simulation that steps, with the forces of effects at every step."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor

from mkc_torch.simulation.continuation import is_plain
from mkc_torch.simulation.dynamics.equations import Equations
from mkc_torch.simulation.dynamics.observer import Observer
from mkc_torch.simulation.dynamics.ports import ENTRIES, RATES
from mkc_torch.simulation.dynamics.trajectory import Grid, Trajectory, solve
from mkc_torch.simulation.dynamics.varying import Acting
from mkc_torch.simulation.ports import Change, Changes, Port

if TYPE_CHECKING:
    from jaxtyping import Float


class Stepping(Protocol):
    """The part of a prepared system that a rollout uses.

    Attributes:
        system: the equations, which step.
        grid: the grid times.
        observer: that corrects the states; None in open loop.
    """

    system: Equations
    grid: Grid
    observer: Observer | None

    @property
    def ports(self) -> Mapping[str, Port]: ...
    def acting(self, theta: Tensor, changes: Changes) -> Acting: ...


def rolls_out(prepared: Stepping, theta: Float[Tensor, " p"], changes: Changes) -> bool:
    """Whether a trajectory is one call of a simulation that steps: no force depends on its states."""
    if prepared.system.steps is None or prepared.observer is not None or not is_plain(theta):
        return False
    return not any(prepared.ports[name].kind in (*RATES, *ENTRIES) for name in changes if name in prepared.ports)


def rolled_out(
    prepared: Stepping,
    rate: Callable[[Tensor], Tensor],
    theta: Float[Tensor, " p"],
    changes: Changes,
    begin: Float[Tensor, "K w"],
) -> Trajectory:
    """Return the trajectory by plain steps; it has not converged where the simulation or an internal state fails.

    Args:
        prepared: the simulation.
        rate: rates of change of the states at the stations.
        theta: the parameters.
        changes: the changes by effects, by port.
        begin: (K, w), the initial states of the trajectories, with internal states of effects.
    """
    guess = plain_steps(prepared, theta, changes, begin)
    if guess is None:
        return Trajectory(begin.new_zeros(len(prepared.grid.time), begin.shape[1]), False)
    return solve(rate, prepared.grid, begin, guess)


def plain_steps(
    prepared: Stepping, theta: Float[Tensor, " p"], changes: Changes, begin: Float[Tensor, "K w"]
) -> Float[Tensor, "G w"] | None:
    """Return the states by plain steps, as in :func:`rolled_out`; None where the simulation or a state fails."""
    found = free_steps(prepared, theta, changes, begin)
    return found if found is not None and bool(found.isfinite().all()) else None


def free_steps(
    prepared: Stepping, theta: Float[Tensor, " p"], changes: Changes, begin: Float[Tensor, "K w"]
) -> Float[Tensor, "G w"] | None:
    """Return the states by plain steps, NaN from a step that fails on; None where there are no such steps."""
    system, now = prepared.system, prepared.acting(theta, changes)
    if system.steps is None or begin.shape[1] > len(system.states):  # internal states of effects have no step
        return None
    names = enumerate(system.inputs)
    entering = {k: changes[f"entry of {name}"] for k, name in names if f"entry of {name}" in changes}
    rollout = system.steps.rollout
    return stepped(
        lambda state, inputs: rollout(state, inputs, now.parameters), prepared.grid, begin, now.inputs, entering
    )


def stepped(
    after: Callable[[Float[Tensor, "1 n"], Float[Tensor, "T u"]], Float[Tensor, "T n"]],
    grid: Grid,
    begin: Float[Tensor, "K n"],
    inputs: Float[Tensor, "S u"],
    entering: Mapping[int, Change],
) -> Float[Tensor, "G n"]:
    """Step from the initial states of each trajectory.

    Args:
        after: from a state (1, n), and the inputs of T steps, to the states after each; without ``entering`` all steps
            of a trajectory are one call.
        grid: grid times of K trajectories.
        begin: (K, n), the initial states.
        inputs: (S, u), the inputs at the stations, as they act.
        entering: number of an input, to the change that depends on the states and the inputs.

    Returns:
        The states, (G, n); NaN after a step that fails.
    """
    first = grid.begins.nonzero().squeeze(-1).tolist()
    ends = [*first[1:], len(grid.time)]
    found = begin.new_empty(len(grid.time), begin.shape[1])
    for start, end, state in zip(first, ends, begin, strict=True):
        found[start] = state
        driven = inputs[start : end - 1]
        if not entering:
            found[start + 1 : end] = after(state.unsqueeze(0), driven)
            continue
        for k in range(start, end - 1):
            now = driven[[k - start]]
            signal = torch.cat([found[[k]], now], -1).expand(len(inputs), -1)
            added = now.clone()
            for place, change in entering.items():
                added[0, place] += change(signal)[k, 0]
            found[k + 1] = after(found[[k]], added)[0]
    return found
