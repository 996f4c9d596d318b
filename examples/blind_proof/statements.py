"""The statements of a diagnosis in terms of the score, and whether they are right."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from examples.blind_proof.aims import COVERAGE_FACTOR
from examples.blind_proof.key import KeyEffect, KeyParameter
from examples.blind_proof.magnetometer.families import POSITION

NOTHING, UNKNOWN, FAILED = "nothing", "unknown", "failed"
UNFIT, ADEQUATE, EXPLAINED, UNEXPLAINED = "unfit", "adequate", "explained", "unexplained"
VERDICTS = (UNFIT, ADEQUATE, EXPLAINED, UNEXPLAINED, FAILED)

CLAIMS = ("left_out", "small")
"""Grades of findings that claim missing physics. A finding without a grade is a claim, too."""

NEAREST = "nearest"

_WITHHELD = ("offset_drift", "hard_iron_step", UNKNOWN)
"""Right names if the driver was not recorded: only its time course can be found."""

_NO_DRIVERS = frozenset(("time", "field", "mag_x", "mag_y", "mag_z"))


@dataclass(frozen=True)
class StatedCandidate:
    """An effect with its drivers and, in ``at``, the channels it acts on."""

    effect: str
    drivers: frozenset[str]
    at: frozenset[str] = frozenset()


@dataclass(frozen=True)
class StatedFinding:
    """A finding. ``others`` are alternatives that the recording cannot rule out; ``grade`` is "" if there is none."""

    named: StatedCandidate
    others: tuple[StatedCandidate, ...]
    onset: float | None
    onset_interval: tuple[float, float] | None
    parameters: tuple[Mapping[str, Any], ...]
    grade: str = ""

    @property
    def claimed(self) -> bool:
        """Whether the finding claims that this physics is missing."""
        return not self.grade or self.grade in CLAIMS


@dataclass(frozen=True)
class StatedDiagnosis:
    """A diagnosis; ``verdict`` is ``failed`` if there is none.

    Example:
        >>> stated = stated_diagnosis(
        ...     {"verdict": "unexplained", "findings": [{"effect": "backlash", "grade": "unconfirmed"}]}
        ... )
        >>> stated.alarm, stated.name
        (False, 'unknown')
    """

    verdict: str
    p_value: float | None
    findings: tuple[StatedFinding, ...]

    @property
    def claims(self) -> tuple[StatedFinding, ...]:
        """The findings that claim missing physics, strongest first."""
        return tuple(finding for finding in self.findings if finding.claimed)

    @property
    def nearest(self) -> tuple[StatedFinding, ...]:
        """The findings that are only the nearest effects in the catalogue."""
        return tuple(finding for finding in self.findings if finding.grade == NEAREST)

    @property
    def alarm(self) -> bool:
        """Whether it claims missing physics; "unexplained" without a claim, "unfit" and a refusal do not."""
        return bool(self.claims)

    @property
    def found(self) -> bool:
        """Whether it reports something, named or not."""
        return self.verdict not in (ADEQUATE, FAILED) or bool(self.findings)

    @property
    def name(self) -> str:
        """The name of the first claim, or what stands for it."""
        if self.claims:
            return self.claims[0].named.effect
        return {ADEQUATE: NOTHING, FAILED: FAILED, UNFIT: UNFIT}.get(self.verdict, UNKNOWN)


def stated_diagnosis(diagnosis: Mapping[str, Any] | None) -> StatedDiagnosis:
    """Read the content of ``diagnosis.json``; None is a failed diagnosis."""
    if diagnosis is None:
        return StatedDiagnosis(FAILED, None, ())
    p_value = diagnosis.get("p_value")
    findings = tuple(_finding(numbers) for numbers in diagnosis.get("findings", ()))
    return StatedDiagnosis(diagnosis["verdict"], None if p_value is None else float(p_value), findings)


def _finding(numbers: Mapping[str, Any]) -> StatedFinding:
    others = [other for other in numbers.get("alternatives") or () if not other.get("separable", True)]
    return StatedFinding(
        _candidate(numbers),
        tuple(_candidate(other) for other in others),
        numbers.get("onset"),
        None if numbers.get("onset_interval") is None else (numbers["onset_interval"][0], numbers["onset_interval"][1]),
        tuple(numbers.get("parameters") or ()),
        numbers.get("grade") or "",
    )


def _candidate(numbers: Mapping[str, Any]) -> StatedCandidate:
    return StatedCandidate(
        numbers["effect"],
        frozenset(numbers.get("drivers") or ()) - _NO_DRIVERS,
        frozenset(numbers.get("channels") or ()),
    )


def named_right(named: StatedCandidate, truth: KeyEffect) -> bool:
    """Whether it is the hidden effect, or a rival that the data cannot distinguish from it."""
    if truth.withheld:
        return named.effect in _WITHHELD or _is_inseparable(named, truth)
    return named.effect == truth.effect or _is_inseparable(named, truth)


def driver_right(named: StatedCandidate, truth: KeyEffect) -> bool:
    """Whether its drivers are those of the hidden effect, or of a rival that the data cannot distinguish from it."""
    if truth.effect == "field_gradient" and truth.drivers:
        own = bool(named.drivers) and named.drivers <= frozenset(POSITION)
    else:
        own = named.drivers == frozenset(truth.drivers)
    return own or any(named.drivers == frozenset(rival.drivers) for rival in truth.inseparable)


def located_right(named: StatedCandidate, truth: KeyEffect) -> bool:
    """Whether it acts at a port of the hidden effect, or of a rival that the data cannot distinguish from it."""
    return bool(named.at & set(truth.at)) or any(named.at & set(rival.at) for rival in truth.inseparable)


def _is_inseparable(named: StatedCandidate, truth: KeyEffect) -> bool:
    return any(
        (rival.effect, frozenset(rival.drivers)) == (named.effect, named.drivers)
        and (not rival.at or bool(named.at & set(rival.at)))
        for rival in truth.inseparable
    )


def covered(finding: StatedFinding, truth: KeyParameter) -> list[bool] | None:
    """Return for each number of a parameter whether the 90 % interval covers it; None if there is no counterpart.

    A parameter of the diagnosis corresponds to that of the key if unit and shape agree.
    """
    value = torch.tensor(truth.value, dtype=torch.float64)
    for parameter in finding.parameters:
        if parameter.get("unit") != truth.unit or parameter.get("standard_error") is None:
            continue
        stated, error = _numbers(parameter["value"]), _numbers(parameter["standard_error"])
        if stated is None or error is None or stated.shape != value.shape or error.shape != value.shape:
            continue
        return ((stated - value).abs() <= COVERAGE_FACTOR * error).ravel().tolist()
    return None


def _numbers(value: float | Sequence[Any]) -> torch.Tensor | None:
    try:
        return torch.tensor(value, dtype=torch.float64)
    except (TypeError, ValueError):
        return None


_RATE = "rate of "


def driven_state(diagnosis: Mapping[str, Any] | None) -> str | None:
    """Return the state with the largest ratio of process noise to its standard error.

    Without process noise it is the state of the first disturbance, or of the first finding.

    Args:
        diagnosis: content of ``diagnosis.json``; None if there is none.

    Returns:
        The state's name; None if the diagnosis names none.

    Example:
        >>> sizes = {"angle": {"size": 0.2, "standard_error": 0.4}, "speed": {"size": 0.3, "standard_error": 0.1}}
        >>> driven_state({"noise": {"process": sizes}})
        'speed'
    """
    if diagnosis is None:
        return None
    return _from_noise(diagnosis) or _from_disturbance(diagnosis) or _from_findings(diagnosis)


def sensor_errs(diagnosis: Mapping[str, Any] | None) -> bool:
    """Whether the diagnosis reports a drift of a sensor in addition to its white noise.

    Example:
        >>> sensor_errs({"noise": {"sensor": {"height": {"size": 0.4}}}}), sensor_errs({"noise": {}})
        (True, False)
    """
    sensors = _mapping(_mapping((diagnosis or {}).get("noise")).get("sensor"))
    return any(_number(_mapping(drift).get("size")) > 0.0 for drift in sensors.values())


def _from_noise(diagnosis: Mapping[str, Any]) -> str | None:
    process = _mapping(_mapping(diagnosis.get("noise")).get("process"))
    ratios = {state: _ratio(_mapping(noise)) for state, noise in process.items()}
    best = max(ratios, key=ratios.__getitem__, default=None)
    return best if best is not None and ratios[best] > 0.0 else None


def _ratio(noise: Mapping[str, Any]) -> float:
    """Return size over standard error; 0 if either is unknown."""
    size, error = _number(noise.get("size")), _number(noise.get("standard_error"))
    return size / error if size > 0.0 and error > 0.0 else 0.0


def _from_disturbance(diagnosis: Mapping[str, Any]) -> str | None:
    disturbance = diagnosis.get("disturbance")
    entries = disturbance if isinstance(disturbance, list) else []
    return next((str(entry["state"]) for entry in entries if _mapping(entry).get("state")), None)


def _from_findings(diagnosis: Mapping[str, Any]) -> str | None:
    """Return the state of the first finding: its own state, or the state in whose rate it acts."""
    findings = diagnosis.get("findings") or []
    first = _mapping(findings[0]) if findings else {}
    if first.get("state"):
        return str(first["state"])
    places = [str(place) for place in first.get("channels") or ()]
    return next((place.removeprefix(_RATE) for place in places if place.startswith(_RATE)), None)


def _mapping(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _number(value: object) -> float:
    """Return a finite number; 0 for everything else."""
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return float(value) if is_number and math.isfinite(float(value)) else 0.0  # type: ignore[arg-type]
