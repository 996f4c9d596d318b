"""A user's functions tried once, at the first guess: shapes, names, and values that are finite."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

from torch import Tensor

from mkc_torch.simulation.dynamics.equations import Equations
from mkc_torch.simulation.dynamics.user_functions import check_value, namespace
from mkc_torch.simulation.names import Names
from mkc_torch.simulation.parameter import SimulationError

if TYPE_CHECKING:
    from jaxtyping import Float, Int

__all__ = ["SampledStates", "check_functions"]


class SampledStates(NamedTuple):
    """Times in s with the states, the inputs and the runs then."""

    time: Float[Tensor, " S"]
    states: Float[Tensor, "S n"]
    inputs: Float[Tensor, "S u"]
    run: Int[Tensor, " S"]


def check_functions(
    system: Equations, p: Names, stations: SampledStates, samples: SampledStates, channels: tuple[str, ...]
) -> None:
    """Refuse functions that do not fit the names of the system.

    Args:
        system: whose functions are tried.
        p: its parameters.
        stations, samples: where rates, and where outputs are computed.
        channels: the outputs that are compared.

    Raises:
        SimulationError: a wrong shape, a name that is missing, or values that are not finite.
    """
    x, u = namespace(system.states, stations.states), namespace(system.inputs, stations.inputs)
    found = system.derivative(stations.time, x, u, p)
    if isinstance(found, Mapping):
        if set(found) != set(system.states):
            raise SimulationError(
                f"{system.name}.derivative returns rates of {', '.join(map(str, found))} but the states are "
                f"{', '.join(system.states)}; return one rate for each state."
            )
    elif len(found) != len(system.states):
        raise SimulationError(
            f"{system.name}.derivative returns {len(found)} rates for {len(system.states)} states "
            f"({', '.join(system.states)}); return one rate for each state."
        )
    values = [found[s] for s in system.states] if isinstance(found, Mapping) else list(found)
    for state, value in zip(system.states, values, strict=True):
        check_value(f"{system.name}.derivative: the rate of `{state}`", value, stations.time, x, p)
    acting = system.actuator(stations.time, u, p, stations.run)
    for name in system.inputs:
        if name not in acting:
            raise SimulationError(
                f"{system.name}.actuated does not return `{name}`, which is one of its inputs; it returns "
                f"{', '.join(map(str, acting)) or 'nothing'}."
            )
        check_value(f"{system.name}.actuated: `{name}`", acting[name], stations.time, x, p)
    at, u = namespace(system.states, samples.states), namespace(system.inputs, samples.inputs)
    outputs = system.output(samples.time, at, u, p)
    for name in channels:
        if name not in outputs:
            raise SimulationError(
                f"{system.name}.output does not return `{name}`, which is in its outputs; it returns "
                f"{', '.join(map(str, outputs))}."
            )
        check_value(f"{system.name}.output: `{name}`", outputs[name], samples.time, at, p)
