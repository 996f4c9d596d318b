"""Read from a diagnosis' JSON which state or sensor it reports as disturbed. Missing entries are skipped."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

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
