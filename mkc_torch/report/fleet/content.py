"""What the results of several recordings have in common, of diagnoses from their diagnosis.json."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from mkc_torch._support.random_effects import (
    FEWEST_FOR_TREND,
    Departure,
    RandomEffects,
    Trend,
    departures,
    random_effects,
    trend,
)
from mkc_torch.diagnosis.verdict import NAMED

START = "start"
"""Name of the condition of a recording that is its first time."""

NEAREST = "nearest"
"""Grade of an effect that is only the nearest to what is missing."""

_SIGNIFICANT = 0.05


class Condition(NamedTuple):
    """A mean over a recording, or its first time."""

    value: float
    unit: str


@dataclass(frozen=True)
class FleetRecording:
    """A diagnosed recording.

    Attributes:
        name: its folder within that of the results.
        simulation, verdict, answer: of its diagnosis.
        stopped: whether the search was stopped before its end.
        residuals: RMSE without and with the findings, and the unit, by output.
        conditions: by name.
    """

    name: str
    simulation: str
    verdict: str
    answer: str
    stopped: bool
    residuals: Mapping[str, tuple[float, float, str]]
    conditions: Mapping[str, Condition]


class Size(NamedTuple):
    """A parameter of a finding in a recording; the error is nan if it is not known."""

    recording: int
    value: float
    error: float
    grade: str


@dataclass(frozen=True)
class Quantity:
    """A parameter of an effect at a place, in all recordings that it was found in.

    Attributes:
        effect, place, parameter, unit: of the finding; the drivers are part of the place.
        sizes: in the order of the recordings.
        pooled: mean and spread of the compared sizes; None for fewer than two with an error.
        departing: recordings that depart from the others.
        rest: mean and spread without them; None if there are none, or fewer than two others.
        trends: of the conditions with a significant trend in the recordings that do not depart, by name.
    """

    effect: str
    place: str
    parameter: str
    unit: str
    sizes: tuple[Size, ...]
    pooled: RandomEffects | None = None
    departing: tuple[Departure, ...] = ()
    rest: RandomEffects | None = None
    trends: Mapping[str, Trend] = field(default_factory=dict)

    @property
    def compared(self) -> tuple[Size, ...]:
        """The sizes that are compared: not those of effects that are only nearest to what is missing."""
        return tuple(size for size in self.sizes if size.grade != NEAREST)

    @property
    def unconfirmed(self) -> int:
        """How many of the compared sizes are of findings that their recording alone does not confirm."""
        return sum(size.grade not in NAMED for size in self.compared)

    @property
    def title(self) -> str:
        """Effect and place in words."""
        return f"{self.effect.replace('_', ' ')}, {self.place}"

    @property
    def own_name(self) -> str:
        """Name of the parameter if it is not that of the effect; else empty."""
        return "" if self.parameter == self.effect else self.parameter


@dataclass(frozen=True)
class Fleet:
    """The results of several recordings, and the recordings without a result, with the reason.

    Attributes:
        recordings: with a result.
        quantities: their findings, or the numbers of their calibrations.
        failures: reason by the name of each recording without a result.
        kind: what was done with each recording, "diagnosed" or "calibrated".
    """

    recordings: tuple[FleetRecording, ...]
    quantities: tuple[Quantity, ...]
    failures: Mapping[str, str]
    kind: str = "diagnosed"


def fleet_of(diagnoses: Mapping[str, Mapping[str, Any]], failures: Mapping[str, str] | None = None) -> Fleet:
    """Return what the diagnoses of several recordings have in common.

    For each parameter of a finding in two recordings or more: its mean and its spread between them; the
    recordings that depart from the others; and its trends with the recordings' conditions, of which the p-values are
    multiplied by the number of conditions.

    Args:
        diagnoses: content of each diagnosis.json, by the name of the recording.
        failures: reason by the name of each recording that was not diagnosed.

    Example:
        >>> fleet_of({}).quantities
        ()
    """
    recordings = tuple(_recording(name, content) for name, content in diagnoses.items())
    sizes: dict[tuple[str, str, str, str], list[Size]] = {}
    for number, content in enumerate(diagnoses.values()):
        for finding in content["findings"]:
            place = ", ".join([*finding["channels"], *(f"by {driver}" for driver in finding["drivers"])])
            for each in finding["parameters"]:
                for name, value, error in _components(each, finding["channels"]):
                    size = Size(number, value, error, finding["grade"])
                    sizes.setdefault((finding["effect"], place, name, each["unit"]), []).append(size)
    quantities = [compared(Quantity(*key, tuple(found)), recordings) for key, found in sizes.items()]
    quantities.sort(key=lambda quantity: -len(quantity.compared))
    return Fleet(recordings, tuple(quantities), {} if failures is None else failures)


def _components(parameter: Mapping[str, Any], channels: Sequence[str]) -> Iterator[tuple[str, float, float]]:
    """Name, value and error of a parameter, or of each of its components, such as those of the sensor's axes."""
    name, value, error = parameter["name"], parameter["value"], parameter["standard_error"]
    if not isinstance(value, list):
        yield name, value, math.nan if error is None else error
        return
    parts = channels if len(channels) == len(value) else [str(number) for number in range(1, len(value) + 1)]
    errors = error if isinstance(error, list) else [error] * len(value)
    for part, own, own_error in zip(parts, value, errors, strict=True):
        component = {"name": f"{name}, {part}", "value": own, "standard_error": own_error}
        yield from _components(component, channels)


def _recording(name: str, content: Mapping[str, Any]) -> FleetRecording:
    before, after = (content[which].get("outputs", {}) for which in ("baseline", "corrected"))
    residuals = {
        output: (size["rmse"], after[output]["rmse"], size["unit"])
        for output, size in before.items()
        if output in after
    }
    conditions = {
        condition: Condition(each["value"], each["unit"]) for condition, each in content.get("conditions", {}).items()
    }
    return FleetRecording(
        name,
        content["simulation"],
        content["verdict"],
        content.get("answer", ""),
        content["search"]["stopped"] is not None,
        residuals,
        conditions,
    )


def compared(quantity: Quantity, recordings: Sequence[FleetRecording]) -> Quantity:
    """Return a quantity with mean, spread, departures and trends of its sizes, where they can be compared."""
    known = [size for size in quantity.compared if size.error > 0.0 and math.isfinite(size.value)]
    if len(known) < 2 or quantity.effect == "unknown":  # a curve without a name has no size to compare
        return quantity
    far = [replace(each, unit=known[each.unit].recording) for each in departures(*_numbers(known))]
    far = [each for each in far if each.p_value < _SIGNIFICANT]
    others = [size for size in known if size.recording not in {each.unit for each in far}]
    rest = random_effects(*_numbers(others)) if far and len(others) > 1 else None
    pooled = random_effects(*_numbers(known))
    return replace(quantity, pooled=pooled, departing=tuple(far), rest=rest, trends=_trends(others, recordings))


def _numbers(sizes: Sequence[Size]) -> tuple[list[float], list[float]]:
    return [size.value for size in sizes], [size.error for size in sizes]


def _trends(known: Sequence[Size], recordings: Sequence[FleetRecording]) -> dict[str, Trend]:
    """The significant trends with conditions that all recordings of these sizes have."""
    if len(known) < FEWEST_FOR_TREND:
        return {}
    own = [recordings[size.recording].conditions for size in known]
    shared = [name for name in own[0] if all(name in each for each in own)]
    found = {name: trend(*_numbers(known), [each[name].value for each in own]) for name in shared}
    differing = {name: each for name, each in found.items() if each is not None}
    return {name: each for name, each in differing.items() if each.p_value * len(differing) < _SIGNIFICANT}
