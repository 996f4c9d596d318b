"""Effects that depend on states and act on inputs, such as friction at a motor, with their internal states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.simulation.dynamics.equations import Equations
from mkc_torch.simulation.dynamics.ports import ENTRIES
from mkc_torch.simulation.dynamics.varying import Acting
from mkc_torch.simulation.ports import Changes, Port

if TYPE_CHECKING:
    from jaxtyping import Float


def entered(
    ports: Mapping[str, Port],
    names: Sequence[str],
    acting: Acting,
    states: Float[Tensor, "S n"],
    changes: Changes,
    memories: Mapping[str, Float[Tensor, "S k"]] = MappingProxyType({}),
) -> tuple[Acting, dict[str, Float[Tensor, "S k"]]]:
    """Return the acting inputs with the effects at their entries, and the rates of these effects' internal states.

    Args:
        ports: of the simulation.
        names: of the inputs.
        acting: the inputs and parameters without these effects.
        states: of the simulation.
        changes: the changes by effects, by port.
        memories: internal states by port; without them an effect follows from the states along their path.
    """
    added = {name: port for name, port in ports.items() if port.kind in ENTRIES and name in changes}
    if not added:
        return acting, {}
    signal = torch.cat([states, acting.inputs], -1)
    inputs, rates = dict(zip(names, acting.inputs.unbind(-1), strict=True)), {}
    for name, port in added.items():
        found = changes[name](torch.cat([signal, memories[name]], -1) if name in memories else signal)
        inputs[port.channels[0]] = inputs[port.channels[0]] + found[:, 0]
        if name in memories:
            rates[name] = found[:, 1:]
    return acting._replace(inputs=torch.stack(list(inputs.values()), -1)), rates


def over_a_step(
    port: Port, rates: Float[Tensor, "S k"], plain: Sequence[Float[Tensor, " S"]], system: Equations
) -> Sequence[Float[Tensor, " S"]]:
    """Return the rates of an effect's internal states over a step of a simulation that steps.

    A deflection moves with the speeds at the end of the step, as positions do in simulators: a mass on a spring keeps
    its energy then.

    Args:
        port: where the effect acts.
        rates: of its internal states, at the start of the step.
        plain: of the simulation's states.
        system: the simulation.
    """
    if port.stands_for != "resonant rate" or system.steps is None:
        return rates.unbind(-1)
    deflection, speed = rates.unbind(-1)
    own = plain[system.states.index(port.parts["own"])]
    return deflection + system.steps.size * (speed - own), speed
