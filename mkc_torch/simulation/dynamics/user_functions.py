"""Checks of a user's system: consistent names, and function values of the right shape that are finite."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.simulation.dynamics.equations import Equations
from mkc_torch.simulation.names import Names
from mkc_torch.simulation.parameter import Parameter, SimulationError

if TYPE_CHECKING:
    from jaxtyping import Float


def check_names(system: Equations) -> None:
    """Raise where names of the system are missing, repeated or not valid as attributes."""
    for what in ("states", "inputs", "outputs"):
        if isinstance(given := getattr(system, what), str):
            raise SimulationError(
                f"{system.name}: `{what}` expected a tuple of names, got the text {given!r}; write ({given!r},)."
            )
    names = [*system.states, *system.inputs, *system.parameters]
    if system.input_hold not in ("held", "linear", "smooth"):
        raise SimulationError(
            f'{system.name}: `input_hold` expected "held", "linear" or "smooth", got {system.input_hold!r}.'
        )
    if not system.states:
        raise SimulationError(f"{system.name} has no `states`; name them.")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise SimulationError(
            f"{system.name} uses the name `{twice[0]}` twice among states, inputs and parameters; rename one of them."
        )
    for name in names:
        if not name.isidentifier():
            raise SimulationError(f"{system.name}: `{name}` cannot be an attribute; use letters, digits and _.")


def check_value(what: str, value: object, time: Tensor, x: Names, p: Names) -> None:
    """Raise where a function's value has a wrong shape or is not finite; ``what`` names it."""
    if not isinstance(value, Tensor) or value.dim() > 1 or (value.dim() == 1 and len(value) not in (1, len(time))):
        found = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        raise SimulationError(f"{what} should be a tensor of shape ({len(time)},), like the states, but is {found}.")
    bad = (~value.isfinite()).expand(len(time)).nonzero()
    if len(bad):
        row = int(bad[0])
        state_values = ", ".join(f"{name} = {float(v.expand(len(time))[row]):.4g}" for name, v in vars(x).items())
        parameter_values = ", ".join(f"{name} = {float(v):.4g}" for name, v in vars(p).items())
        raise SimulationError(
            f"{what} is {float(value.expand(len(time))[row])} at time {float(time[row]):.4g} s with {state_values}; "
            f"parameters {parameter_values or 'none'}. Keep it finite there, or start from other parameters."
        )


def kinematic(system: Equations, known: Mapping[str, Parameter]) -> dict[str, str]:
    """States whose rate is another state, to that state, as from a position to its speed.

    No physics can be missing there.
    """
    if system.steps is not None:
        return dict(system.steps.positions)
    generator = torch.Generator().manual_seed(0)

    def drawn(count: int) -> Tensor:
        return torch.rand(20, count, generator=generator, dtype=torch.float64) + 0.1

    states = drawn(len(system.states))
    x, u = namespace(system.states, states), namespace(system.inputs, drawn(len(system.inputs)))
    p = Names(**{name: torch.tensor(parameter.value).double() for name, parameter in known.items()})
    found = system.derivative(drawn(1)[:, 0], x, u, p)
    if not isinstance(found, Mapping | Sequence | Tensor):
        raise SimulationError(
            f"{system.name}.derivative returns {type(found).__name__}; return the rate of each state, by name or in "
            "the order of `states`."
        )
    rates = [found[s] for s in system.states] if isinstance(found, Mapping) and set(found) >= set(system.states) else []
    if not isinstance(found, Mapping) and len(found) == len(system.states):
        rates = list(found)
    pairs = {}
    for state, rate in zip(system.states, rates, strict=False):
        for other, value in zip(system.states, states.unbind(-1), strict=True):
            if state != other and isinstance(rate, Tensor) and rate.shape == value.shape and torch.equal(rate, value):
                pairs[state] = other
    return pairs


def namespace(names: Sequence[str], values: Float[Tensor, "S n"]) -> Names:
    """The columns of values as attributes of these names."""
    return Names(**dict(zip(names, values.unbind(-1), strict=True)))
