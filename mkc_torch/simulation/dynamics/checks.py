"""Check a user's functions once, at the first guess: shapes, names, and finite values."""

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


class SampledStates(NamedTuple):
    """Times in s with the states, the inputs and the number of the run at each."""

    time: Float[Tensor, " S"]
    states: Float[Tensor, "S n"]
    inputs: Float[Tensor, "S u"]
    run: Int[Tensor, " S"]


def check_functions(
    system: Equations, p: Names, stations: SampledStates, samples: SampledStates, channels: tuple[str, ...]
) -> None:
    """Raise where a function of the system returns wrong names, wrong shapes or values that are not finite.

    Args:
        system: the system to check.
        p: its parameters.
        stations: where rates are computed.
        samples: where outputs are computed.
        channels: the outputs that are compared with the recording.

    Raises:
        SimulationError: a wrong shape, a missing name, or values that are not finite.
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
                f"{system.name}.actuator does not return the input `{name}`; it returns "
                f"{', '.join(map(str, acting)) or 'nothing'}. Return every input."
            )
        check_value(f"{system.name}.actuator: `{name}`", acting[name], stations.time, x, p)
    at, u = namespace(system.states, samples.states), namespace(system.inputs, samples.inputs)
    outputs = system.output(samples.time, at, u, p)
    for name in channels:
        if name not in outputs:
            raise SimulationError(
                f"{system.name}.output does not return `{name}`, which is in its outputs; it returns "
                f"{', '.join(map(str, outputs))}. Return every output."
            )
        check_value(f"{system.name}.output: `{name}`", outputs[name], samples.time, at, p)
