"""Parameters that may vary with time, as a resistance does with a recorded temperature."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from mkc_torch.simulation.dynamics.equations import Equations
from mkc_torch.simulation.dynamics.user_functions import namespace
from mkc_torch.simulation.names import Names
from mkc_torch.simulation.parameter import Parameter
from mkc_torch.simulation.scattered import scattered

if TYPE_CHECKING:
    from jaxtyping import Float

_ROWS = 20
"""Number of moments at which the functions are compared; no usual number of states, inputs or parameters."""


_OTHER = 1.1
"""Factor by which a parameter is changed to find out whether the sensor depends on it."""


class Acting(NamedTuple):
    """The inputs and the parameters as they act, with effects and the actuator, at S moments.

    Attributes:
        inputs: (S, u).
        parameters: by name, a number each; (S,) where an effect changes it with time.
    """

    inputs: Float[Tensor, "S u"]
    parameters: Names


def varying_parameters(system: Equations) -> tuple[str, ...]:
    """Find the parameters that a system's functions also accept as a function of time.

    A function that needs a number, such as a condition on a parameter or a lag, does not accept it. Parameters of the
    sensor, which has no inputs, and offsets of single recordings are left out.

    Args:
        system: the equations.

    Example:
        >>> from mkc_torch.simulation import Dynamics
        >>> class Tank(Dynamics):
        ...     states, inputs, parameters = ("level",), ("inflow",), {"drain": 0.3, "leak": 0.1}
        ...
        ...     def derivative(self, time, x, u, p):
        ...         loss = p.leak if p.leak > 0 else 0.0
        ...         return {"level": u.inflow - p.drain * x.level - loss}
        >>> varying_parameters(Tank())
        ('drain',)
    """
    offsets = {offset.name for offset in system.own_offsets}
    names = [name for name in system.parameters if name not in offsets]
    return tuple(name for name in names if _accepts(system, name))


def _accepts(system: Equations, name: str) -> bool:
    """Whether the functions return the same for a parameter as a number and as an equal column."""
    values = {
        key: (parameter.value if isinstance(parameter, Parameter) else float(parameter)) or 1.0
        for key, parameter in system.parameters.items()
    }
    numbers = {key: torch.tensor(value).double() for key, value in values.items()}
    column, other = numbers[name].expand(_ROWS).clone(), _OTHER * numbers[name]
    # a user's function may raise anything on a column
    try:
        plain, varied = (_values(system, Names(**{**numbers, name: value})) for value in (numbers[name], column))
        before, after = (_measured(system, Names(**{**numbers, name: value})) for value in (numbers[name], other))
    except Exception:
        return False
    return _alike(plain, varied) and _alike(before, after)


def _alike(first: Sequence[Tensor], other: Sequence[Tensor]) -> bool:
    return all(
        a.shape == b.shape and torch.allclose(a, b, rtol=1e-9, equal_nan=True)
        for a, b in zip(first, other, strict=True)
    )


def _values(system: Equations, p: Names) -> list[Tensor]:
    """The acting inputs, rates and outputs at fixed scattered states and inputs."""
    time, run = torch.arange(_ROWS, dtype=torch.float64), torch.zeros(_ROWS, dtype=torch.long)
    x = namespace(system.states, scattered(_ROWS, len(system.states)))
    given = namespace(system.inputs, scattered(_ROWS, len(system.inputs)))
    u = Names(**system.actuator(time, given, p, run))
    found: Any = system.derivative(time, x, u, p)
    rates = [found[state] for state in system.states] if isinstance(found, Mapping) else list(found)
    shown = system.output(time, x, u, p)
    return [value + torch.zeros_like(time) for value in (*vars(u).values(), *rates, *shown.values())]


def _measured(system: Equations, p: Names) -> list[Tensor]:
    """What the sensors show of fixed scattered outputs."""
    time, run = torch.arange(_ROWS, dtype=torch.float64), torch.zeros(_ROWS, dtype=torch.long)
    names = dict.fromkeys((*system.outputs, *system.states))
    y = dict(zip(names, scattered(_ROWS, len(names)).unbind(-1), strict=True))
    return [value + torch.zeros_like(time) for value in system.sensor(time, y, p, run).values()]


def varied(
    p: Names, changes: Mapping[str, Callable[[Tensor], Tensor]], time: Float[Tensor, " S"]
) -> dict[str, Float[Tensor, " S"]]:
    """The parameters that effects change, at the moments of these changes.

    Args:
        p: the parameters as numbers.
        changes: the changes by effects, by port.
        time: the moments at which the changes are known.
    """
    found = {}
    for name, value in vars(p).items():
        if (change := changes.get(f"parameter {name}")) is not None:
            signal = value + torch.zeros_like(time).unsqueeze(-1)
            found[name] = (signal + change(signal))[:, 0]
    return found
