"""Inputs that a state acts relative to, as an ambient temperature."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch

from mkc_torch.recording.recording import DEFAULT_UNITS
from mkc_torch.simulation.dynamics.equations import Equations
from mkc_torch.simulation.dynamics.user_functions import namespace
from mkc_torch.simulation.names import Names
from mkc_torch.simulation.parameter import Parameter, known_parameters
from mkc_torch.simulation.scattered import scattered

_SHIFT = 0.7
"""Common shift of state and input in the test."""

_ROWS = 20
"""Number of moments at which rates are compared."""


def surroundings(system: Equations) -> dict[str, str]:
    """Find the input that each state acts relative to; states without such an input are left out.

    It is an input whose common shift with all states of the state's unit leaves the state's rate unchanged, as with an
    ambient temperature. If there is none, it is an input of the same unit.

    Args:
        system: the equations; units are those declared, or the defaults of the names.

    Example:
        >>> from mkc_torch.simulation import Dynamics
        >>> class Heater(Dynamics):
        ...     states, inputs = ("temp",), ("power", "outside")
        ...     parameters = {"loss": 0.1}
        ...
        ...     def derivative(self, time, x, u, p):
        ...         return {"temp": u.power - p.loss * (x.temp - u.outside)}
        >>> surroundings(Heater())
        {'temp': 'outside'}
    """
    if system.steps is not None:
        return {}  # forces act on its speeds alone
    known = known_parameters(system.name, system.parameters)
    found = {}
    for state in system.states:
        unit = unit_of(system, state)
        alike = [other for other in system.states if other == state or (unit and unit_of(system, other) == unit)]
        shifted = [name for name in system.inputs if _shifts(system, known, state, alike, name)]
        same = [name for name in system.inputs if unit and unit_of(system, name) == unit]
        if shifted or same:
            found[state] = (shifted or same)[0]
    return found


def unit_of(system: Equations, name: str) -> str:
    """The unit that a system declares for a state or an input, or the default of the name; empty without either."""
    return system.units.get(name, DEFAULT_UNITS.get(name, ""))


def _shifts(system: Equations, known: dict[str, Parameter], state: str, alike: list[str], name: str) -> bool:
    """Whether the rate of a state depends on the states of its unit only by their difference to an input."""
    time, states, inputs = (
        scattered(_ROWS, 1),
        scattered(_ROWS, len(system.states)),
        scattered(_ROWS, len(system.inputs)),
    )
    # a parameter of 0 would hide what it multiplies; with a coefficient of 1 any input may look like the surroundings
    values = {
        parameter: (known[parameter].value or 1.0) * (1.0 + 0.01 * math.sqrt(number + 2.0))
        for number, parameter in enumerate(known)
    }
    p = Names(**{parameter: torch.tensor(value).double() for parameter, value in values.items()})

    def rate(of_states: float, of_input: float) -> torch.Tensor:
        moved, driven = states.clone(), inputs.clone()
        moved[:, [system.states.index(other) for other in alike]] += of_states
        driven[:, system.inputs.index(name)] += of_input
        found = system.derivative(time[:, 0], namespace(system.states, moved), namespace(system.inputs, driven), p)
        value = found[state] if isinstance(found, Mapping) else found[system.states.index(state)]
        return value + 0.0 * time[:, 0]

    plain = rate(0.0, 0.0)
    if torch.allclose(rate(_SHIFT, 0.0), plain, rtol=1e-6, equal_nan=False):
        return False
    return torch.allclose(rate(_SHIFT, _SHIFT), plain, rtol=1e-9)
