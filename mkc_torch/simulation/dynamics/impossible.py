"""Fitted values that cannot be: at a bound, a level far outside the recording, a rate that the recording cannot show.

What a parameter means follows from the equations alone: a level of a state shifts with it, and a rate or a time
constant scales the decay of a state.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from mkc_torch.simulation.dynamics.checked import CheckedDynamics
from mkc_torch.simulation.dynamics.trajectory import slopes
from mkc_torch.simulation.names import Names
from mkc_torch.simulation.start_checks import StartCheck

if TYPE_CHECKING:
    from jaxtyping import Float

_AT_END = 1e-6
"""Distance from a bound, relative to the start value, within which a value is at the bound."""

_INSIDE = 1e-3
"""Distance of the start value from the bound, relative to itself, from which the fit has moved to the bound."""

_OUTSIDE = 0.25
"""Distance of a level from the recorded and nominal values, as a share of their range, if far outside. Judgement."""

_LONGEST = 1e3
"""Time constant in durations of the longest run from which a decay does not show. Judgement."""

_SHORTEST = 0.1
"""Time constant in median intervals between samples below which a state follows at once. Judgement."""

_SAME = 1e-6
"""Largest relative change of the rates by a shift that the equations do not notice, and of a ratio of decays."""


@dataclass(frozen=True)
class ImpossibleValue:
    """A fitted value that cannot be.

    Attributes:
        parameter, value, unit: name, fitted value and unit, which is empty if unknown.
        kind: "bound" of the user, "level" of a state, "slow" or "fast" decay of a state.
        state: the state that it is a level or a decay of; empty for a bound.
        limits: of the user, of the recorded values of the state, or of time constants in s.
        acts: 1 if the value raises the rate of the state, −1 if it lowers it, relative to a possible level; 0 for
            other kinds.
    """

    parameter: str
    value: float
    unit: str
    kind: Literal["bound", "level", "slow", "fast"]
    state: str
    limits: tuple[float, float]
    acts: int = 0

    def __str__(self) -> str:
        size = f"{self.value:.4g} {self.unit}".rstrip()
        ends = f"`{self.parameter}` ends at {size}"
        low, high = (f"{limit:.4g}" for limit in self.limits)
        if self.kind == "bound":
            return (
                f"{ends}, its bound: the recording needs a value beyond it. A sign or unit is wrong, or the simulation "
                "lacks something."
            )
        if self.kind == "level":
            what = "a source" if self.acts > 0 else "a loss"
            recorded = f"{low} to {high} {self.unit}".rstrip()
            return (
                f"{ends}, but the recorded values are {recorded}: the simulation lacks something that acts like {what} "
                f"of `{self.state}`."
            )
        if self.kind == "slow":
            return (
                f"{ends}, with which `{self.state}` decays over more than {high} s, a thousand times the longest run: "
                "its term does nothing in this recording."
            )
        return f"{ends}, with which `{self.state}` decays within {low} s, a tenth of the interval between samples."


def at_bounds(prepared: CheckedDynamics, theta: Float[Tensor, " p"]) -> Iterator[tuple[str, float]]:
    """Yield the parameters that were fitted to a bound, and the bound."""
    for number, (name, known) in enumerate(prepared.known.items()):
        value, size = float(theta[number]), max(abs(known.value), 1e-300)
        for bounds in prepared.bounds:
            bound = float(bounds[number])
            if abs(value - bound) <= _AT_END * size and abs(known.value - bound) > _INSIDE * size:
                yield name, bound


def impossible_values(prepared: CheckedDynamics, theta: Float[Tensor, " p"]) -> tuple[ImpossibleValue, ...]:
    """Return the fitted values that cannot be, one for each such parameter, if its nominal value can be.

    Args:
        prepared: the simulation.
        theta: (p,), the fitted parameters.
    """
    theta, nominal = theta[: len(prepared.given)].detach(), prepared.given
    found = {}
    for name, bound in at_bounds(prepared, theta):
        known = prepared.known[name]
        found[name] = ImpossibleValue(name, bound, known.unit, "bound", "", (known.lower, known.upper))
    fitted, begun = _Equations(prepared, theta), _Equations(prepared, nominal)
    for number, name in enumerate(prepared.known):
        for wrong in (_Equations.wrong_level, _Equations.wrong_decay):
            if name not in found and (value := wrong(fitted, number, name)) and not wrong(begun, number, name):
                found[name] = value
    return tuple(found.values())


def impossible_checks(prepared: CheckedDynamics, values: Sequence[ImpossibleValue]) -> tuple[StartCheck, ...]:
    """Return a check before the search for each value, with the nominal value, which the search starts from too."""
    found = []
    for value in values:
        nominal = prepared.known[value.parameter].value
        text = f"{value} The search also starts from the nominal value, {nominal:.4g}."
        found.append(StartCheck("impossible value", (value.parameter,), text, start=nominal))
    return tuple(found)


class _Equations:
    """The rates of a system near the recorded states, as functions of parameters and states."""

    def __init__(self, prepared: CheckedDynamics, theta: Tensor) -> None:
        self._prepared, self._theta = prepared, theta
        self._states = prepared.grid.spread(prepared.guess)
        self._names = prepared.system.states

    def _rates(self, theta: Tensor, states: Tensor, moved: Mapping[str, float] = MappingProxyType({})) -> Tensor:
        """The rates (S, n); ``moved`` shifts inputs, by name."""
        prepared, system = self._prepared, self._prepared.system
        inputs = zip(system.inputs, prepared.inputs.unbind(-1), strict=True)
        u = Names(**{name: column + moved.get(name, 0.0) for name, column in inputs})
        x = Names(**dict(zip(self._names, states.unbind(-1), strict=True)))
        found = system.derivative(prepared.clock.time, x, u, prepared.parameters_of(theta))
        values = [found[name] for name in self._names] if isinstance(found, Mapping) else list(found)
        return torch.stack([value + torch.zeros_like(states[:, 0]) for value in values], -1)

    def wrong_level(self, number: int, name: str) -> ImpossibleValue | None:
        """Return the value as a level of a state that the equations count from it, if it is far outside."""
        value = float(self._theta[number])
        for state, of_level, inputs in self._levels():
            recorded, nominal = self._range_of(state), self._prepared.known[name].value
            low, high = min(recorded[0], nominal), max(recorded[1], nominal)
            if not high > low or low - _OUTSIDE * (high - low) <= value <= high + _OUTSIDE * (high - low):
                continue
            moved = self._theta.clone()
            moved[number] += high - low
            plain, alone = self._rates(self._theta, self._states), self._rates(moved, self._states)
            shifted = self._states.clone()
            shifted[:, of_level] += high - low
            together = self._rates(moved, shifted, dict.fromkeys(inputs, high - low))
            size = float((alone - plain).abs().max())
            if size > 0.0 and float((together - plain).abs().max()) <= _SAME * size:
                place = self._names.index(state)
                possible = self._theta.clone()
                possible[number] = low if value < low else high
                change = float((plain - self._rates(possible, self._states))[:, place].mean())
                unit = self._prepared.known[name].unit or self._prepared.system.units.get(state, "")
                acts = 1 if change > 0.0 else -1
                return ImpossibleValue(name, value, unit, "level", state, recorded, acts)
        return None

    def _levels(self) -> Iterator[tuple[str, list[int], list[str]]]:
        """Yield recorded states, and the states and inputs of the same kind: alone, then all of its unit."""
        system = self._prepared.system
        for place, state in enumerate(self._names):
            if state not in self._prepared.channels:
                continue
            yield state, [place], []
            unit = system.units.get(state, "")
            if unit:
                alike = [k for k, other in enumerate(self._names) if system.units.get(other) == unit]
                inputs = [other for other in system.inputs if system.units.get(other) == unit]
                if len(alike) > 1 or inputs:
                    yield state, alike, inputs

    def _range_of(self, state: str) -> tuple[float, float]:
        """The range of all recorded columns with the unit of a state, or of the state's own column."""
        prepared, unit = self._prepared, self._prepared.system.units.get(state, "")
        names = [state, *(n for n in (*prepared.channels, *prepared.system.inputs) if unit and self._unit(n) == unit)]
        columns = prepared.recording.stack(*dict.fromkeys(names))
        return float(columns.min()), float(columns.max())

    def _unit(self, column: str) -> str:
        return self._prepared.system.units.get(column, "")

    def wrong_decay(self, number: int, name: str) -> ImpossibleValue | None:
        """Return the value as a rate or time constant of a state's decay that the recording cannot show."""
        value = float(self._theta[number])
        if value == 0.0:
            return None
        longest = max(float(run[-1] - run[0]) for run in self._prepared.time.split(self._lengths()))
        interval = float(self._prepared.time.diff()[~self._prepared.begins[1:]].median())
        double = self._theta.clone()
        double[number] *= 2.0
        decays, others = (self._decays(theta) for theta in (self._theta, double))
        for place, state in enumerate(self._names):
            decay, other = decays[:, place], others[:, place]
            usual = float(decay.abs().median())
            if usual == 0.0 or not any(
                bool(((other - factor * decay).abs() <= _SAME * decay.abs()).all()) for factor in (0.5, 2.0)
            ):
                continue
            constant = 1.0 / usual
            limits = _SHORTEST * interval, _LONGEST * longest
            if not limits[0] <= constant <= limits[1]:
                kind: Literal["slow", "fast"] = "slow" if constant > limits[1] else "fast"
                return ImpossibleValue(name, value, self._prepared.known[name].unit, kind, state, limits)
        return None

    def _decays(self, theta: Tensor) -> Float[Tensor, "S n"]:
        """The derivative of each state's rate by the state itself."""
        return slopes(lambda states: self._rates(theta, states), self._states.clone()).diagonal(dim1=1, dim2=2).detach()

    def _lengths(self) -> list[int]:
        first = self._prepared.begins.nonzero().squeeze(-1)
        ends = torch.cat([first[1:], first.new_tensor([len(self._prepared.begins)])])
        lengths: list[int] = (ends - first).tolist()
        return lengths
