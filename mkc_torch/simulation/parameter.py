"""Parameters of simulations, and the error of a simulation that cannot be computed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch

from mkc_torch._support.arguments import checked_number, format_value, refuse_other_type


class SimulationError(ValueError):
    """A simulation that cannot be computed; the message states where and why."""


@dataclass(frozen=True)
class Parameter:
    """A fitted parameter of a simulation.

    Attributes:
        value: start value of the fit.
        lower, upper: bounds. Two finite bounds are also a Gaussian prior, with the mean and the standard deviation of a
            uniform distribution between them, in a fit of differential equations.
        unit: unit in reports.
        uncertainty: standard deviation of a Gaussian prior about ``value``, in a fit of differential equations, in
            place of the prior by the bounds; None for none.

    Raises:
        TypeError: a value or a bound is not a number, or the unit is not a string.
        ValueError: the value is not finite or out of its bounds, or ``lower`` exceeds ``upper``.

    Example:
        >>> Parameter(0.1, lower=0.0, unit="1/s")
        Parameter(value=0.1, lower=0.0, upper=inf, unit='1/s', uncertainty=None)
    """

    value: float
    lower: float = -torch.inf
    upper: float = torch.inf
    unit: str = ""
    uncertainty: float | None = None

    def __post_init__(self) -> None:
        checked_number("value", self.value, -math.inf, math.inf, advice="it is what the fit starts from")
        for name, bound in (("lower", self.lower), ("upper", self.upper)):
            checked_number(name, bound, -math.inf, math.inf, "[]", "it is infinite for no bound")
        if self.lower > self.upper:
            raise ValueError(
                f"Expected argument `lower` to be at most `upper` but got {self.lower} and {self.upper}; swap them."
            )
        if not self.lower <= self.value <= self.upper:
            raise ValueError(
                f"Expected argument `value` to lie in [{self.lower}, {self.upper}], its own bounds, but got "
                f"{self.value}; start within them, or widen them."
            )
        if self.uncertainty is not None:
            checked_number("uncertainty", self.uncertainty, 0.0, math.inf, advice="it is a standard deviation")
        refuse_other_type("unit", self.unit, str, "text", "write '1/s' say")


def known_parameters(name: str, parameters: Mapping[str, float | Parameter]) -> dict[str, Parameter]:
    """The parameters of a simulation as :class:`Parameter`.

    Args:
        name: name of the simulation, for errors.
        parameters: name to parameter or start value.

    Raises:
        SimulationError: ``parameters`` is not a mapping, or a value is not a number.
    """
    if not isinstance(parameters, Mapping):
        raise SimulationError(
            f"{name}: `parameters` should be names with their values, {{'gain': 1.0}}, but is "
            f"{format_value(parameters)}."
        )
    return {
        key: value if isinstance(value, Parameter) else _made(name, key, value) for key, value in parameters.items()
    }


def _made(name: str, key: str, value: float) -> Parameter:
    try:
        return Parameter(float(value))
    except (TypeError, ValueError) as error:
        raise SimulationError(
            f"{name}: its parameter `{key}` should be a finite number or a Parameter but is {format_value(value)}."
        ) from error
