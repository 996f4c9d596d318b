"""All candidates of a recording: effect × driver × shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.model.drivers import Driver
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import Shape
from mkc_torch.simulation.ports import Port, SignalSizes
from mkc_torch.simulation.protocol import PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["candidate_terms", "described", "finer", "reach_of", "within_a_sample"]

_STEPS = 8
"""Grid points of a shape number to either side of its value, and the factor by which its range shrinks each round."""


def candidate_terms(
    prepared: PreparedSimulation, drivers: Sequence[Driver], effects: Sequence[Effect]
) -> tuple[Term, ...]:
    """Return each effect that has a port in the simulation, with each of its drivers and each shape of its grid."""
    terms = []
    for effect in effects:
        places = [name for name, port in prepared.ports.items() if _fits(effect, name, port)]
        # an effect without roles, or with an optional driver, is also tried without a driver
        alone = not effect.roles or effect.driver_optional
        fitting = [*([None] if alone else []), *(d for d in drivers if _drives(d, effect))]
        shapes = effect.shapes(prepared.time)
        terms += [
            Term(effect, driver, shape, "" if at == effect.port else at)
            for at in places
            for driver in fitting
            for shape in (absolute(effect, shape, prepared.ports[at], driver) for shape in shapes)
        ]
    return tuple(term for term in terms if not within_a_sample(term, prepared))


def within_a_sample(term: Term, prepared: PreparedSimulation) -> bool:
    """Whether a candidate only changes what an input does between two samples."""
    inside = prepared.time.diff()
    step = float(inside[inside > 0].median()) if bool((inside > 0).any()) else 0.0
    return term.effect.within_a_sample(term.shape, step)


def _fits(effect: Effect, name: str, port: Port) -> bool:
    """Whether an effect acts at a port."""
    known = set(port.parts)
    return effect.port in (name, port.kind) and set(effect.needs) <= known and known.isdisjoint(effect.excludes)


def absolute(effect: Effect, shape: Shape, port: Port, driver: Driver | None = None) -> Shape:
    """Return a shape in units, from shares of the signal at the port or of the driver."""
    if not effect.relative:
        return shape
    known = dict(port.sizes)
    if driver is not None:
        known["driver"] = SignalSizes.of(torch.linalg.vector_norm(driver.values, dim=-1))
    sizes = {part: values._asdict() for part, values in known.items()}
    return {**shape} | {name: shape[name] * sizes[part][which] for name, (part, which) in effect.relative.items()}


def reach_of(term: Term, prepared: PreparedSimulation) -> dict[str, tuple[float, float]]:
    """Return the lower and upper limits, in units, of the numbers of a shape that are fitted together with γ.

    Raises:
        ValueError: the effect names a number that its shape does not have, or an empty range.
    """
    if not term.effect.fitted_shape:
        return {}
    port, reach = prepared.ports[term.port], term.effect.fitted_shape
    for name, (low, high) in reach.items():
        if name not in term.shape or not low < high:
            raise ValueError(
                f"Expected `fitted_shape` of {term.effect.id} to hold numbers of its shape ({', '.join(term.shape)}) "
                f"with a lower and a greater upper limit but got `{name}`: ({low}, {high}); correct it or "
                "leave it out."
            )
    of_length, length = term.effect.continuous, float(prepared.time[-1] - prepared.time[0])
    ends = [
        absolute(term.effect, {**term.shape, **{n: r[k] for n, r in reach.items()}}, port, term.driver) for k in (0, 1)
    ]
    lower, upper = ({name: end[name] * (length if name in of_length else 1.0) for name in reach} for end in ends)
    return {name: (lower[name], upper[name]) for name in reach}


def _drives(driver: Driver, effect: Effect) -> bool:
    """Whether a driver has one of an effect's roles; a curve without a name accepts any single column."""
    return driver.role in effect.roles or (bool(effect.roles) and effect.is_curve and len(driver.columns) == 1)


def finer(term: Term, name: str, time: Float[Tensor, " N"], rounds: int) -> tuple[Term, ...]:
    """Return the effect with one number of its shape varied, over 1/8 of its range either way, less in later rounds.

    Args:
        term: the effect.
        name: of the number, one of the effect's continuous numbers.
        time: of the recording.
        rounds: how often the range was narrowed before.
    """
    low, high = (share * float(time[-1] - time[0]) for share in term.effect.continuous[name])
    offset = float(time[0]) if name == "onset" else 0.0
    value = term.shape[name]
    reach = (high - low) / _STEPS ** (rounds + 1)
    values = {min(max(value + reach * k / _STEPS, low + offset), high + offset) for k in range(-_STEPS, _STEPS + 1)}
    return tuple(replace(term, shape={**term.shape, name: v}) for v in sorted(values))


def described(effect: Effect, shape: Shape) -> str:
    """Return the reported numbers of a shape as text.

    Example:
        >>> from mkc_torch.effects.sensor.offset_drift import OffsetDrift
        >>> described(OffsetDrift(), {"middle": 12.345, "width": 0.5})
        'middle 12.35 s, width 0.5 s'
    """
    numbers = {name: value for name, value in shape.items() if effect.reports(name)}
    units = {name: effect.shape_units.get(name, "") for name in numbers}
    return ", ".join(f"{name.replace('_', ' ')} {value:.4g} {units[name]}".rstrip() for name, value in numbers.items())
