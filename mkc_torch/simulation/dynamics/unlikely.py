"""Fitted values that the user's own values and their uncertainties make unlikely."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from mkc_torch.simulation.dynamics.checked import CheckedDynamics
from mkc_torch.simulation.parameter import Parameter
from mkc_torch.simulation.start_checks import StartCheck

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

_FAR = 3.0
"""Distance from a given value, in standard deviations, from which a fitted value is unlikely."""


def unlikely_checks(
    prepared: CheckedDynamics, alone: Float[Tensor, " p"], found: Float[Tensor, " p"], instead: str = ""
) -> tuple[StartCheck, ...]:
    """Return a check for each parameter that the fit without effects takes far from its given value.

    Such a number can take the place of an effect: a servo that is too soft follows late.

    Args:
        prepared: the simulation; only parameters with an ``uncertainty`` are checked.
        alone: (p,), parameters of the fit without effects.
        found: (p,), of the fit with the effects found.
        instead: what is found with such numbers held at the values given, in sentences; empty if it is not known.
    """
    checks = []
    for number, (name, known) in enumerate(prepared.known.items()):
        first, last = float(alone[number]), float(found[number])
        if not is_unlikely(prepared, known, first):
            continue
        by_factor = _by_factor(prepared, known)
        expected = (
            f"within a factor of {math.exp(_spread(known)):.2g}"
            if by_factor
            else f"with a standard deviation of {known.uncertainty:.3g}"
        )
        after = f"With what was found it is {last:.4g}."
        if is_unlikely(prepared, known, last):
            after = f"{after} {instead or _again(known)}"
        given = f"{known.value:.4g} {known.unit}".rstrip()
        sentence = (
            f"`{name}` ends at {first:.4g} without effects; given was {given}, {expected}: it can take the place of "
            f"an effect that the simulation lacks. {after}"
        )
        checks.append(StartCheck("unlikely value", (name,), sentence, start=known.value))
    return tuple(checks)


def is_unlikely(prepared: CheckedDynamics, known: Parameter, value: float) -> bool:
    """Whether a fitted value is unlikely by the value given and its uncertainty."""
    return distance(known, value, by_factor=_by_factor(prepared, known)) > _FAR


def price_of_values(prepared: CheckedDynamics, values: Float[Tensor, " p"]) -> float:
    """Half the sum of the squared distances of fitted values from the values given, in nats.

    Bounds without an uncertainty cost nothing.
    """
    pairs = zip(prepared.known.values(), values.tolist(), strict=False)
    away = (distance(known, value, by_factor=_by_factor(prepared, known)) for known, value in pairs)
    return 0.5 * sum(each**2 for each in away)


def _by_factor(prepared: CheckedDynamics, known: Parameter) -> bool:
    """Whether a value is compared by its factor: a positive number of a simulation that steps."""
    return prepared.system.steps is not None and known.lower == 0.0 < known.value


def _again(known: Parameter) -> str:
    return (
        f"If {known.value:.4g} was measured, give it without letting it be fitted, and diagnose again: the effects "
        "that this number replaces are then found."
    )


def distance(known: Parameter, value: float, *, by_factor: bool) -> float:
    """The distance of a fitted value from its given value in standard deviations; 0 without an uncertainty.

    Example:
        >>> servo = Parameter(998.0, lower=0.0, uncertainty=0.69 * 998.0)
        >>> (
        ...     round(distance(servo, 499.0, by_factor=True), 1),
        ...     distance(Parameter(2.0, uncertainty=0.5), 3.0, by_factor=False),
        ... )
        (1.0, 2.0)
    """
    if known.uncertainty is None:
        return 0.0
    if not by_factor:
        return abs(value - known.value) / known.uncertainty
    return abs(math.log(max(value, 1e-300) / known.value)) / _spread(known)


def _spread(known: Parameter) -> float:
    """Standard deviation of the logarithm."""
    return (known.uncertainty or 0.0) / known.value
