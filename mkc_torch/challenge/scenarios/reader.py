"""Which state a diagnosis says is driven, from its JSON; whatever is not there is passed over."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

_RATE = "rate of "


def driven_state(diagnosis: Mapping[str, Any] | None) -> str | None:
    """The state with the largest process noise over its standard error; else the first forcing's, or finding's.

    Args:
        diagnosis: content of ``diagnosis.json``; None where there is none.

    Returns:
        The state's name; None where the diagnosis points at none.

    Example:
        >>> sizes = {"angle": {"size": 0.2, "standard_error": 0.4}, "speed": {"size": 0.3, "standard_error": 0.1}}
        >>> driven_state({"noise": {"process": sizes}})
        'speed'
    """
    if diagnosis is None:
        return None
    return _from_noise(diagnosis) or _from_forcing(diagnosis) or _from_findings(diagnosis)


def sensor_errs(diagnosis: Mapping[str, Any] | None) -> bool:
    """It says that a sensor errs slowly beside its white noise.

    Example:
        >>> sensor_errs({"noise": {"sensor": {"height": {"size": 0.4}}}}), sensor_errs({"noise": {}})
        (True, False)
    """
    sensors = _mapping(_mapping((diagnosis or {}).get("noise")).get("sensor"))
    return any(_number(_mapping(told).get("size")) > 0.0 for told in sensors.values())


def _from_noise(diagnosis: Mapping[str, Any]) -> str | None:
    process = _mapping(_mapping(diagnosis.get("noise")).get("process"))
    ratios = {state: _ratio(_mapping(told)) for state, told in process.items()}
    best = max(ratios, key=ratios.__getitem__, default=None)
    return best if best is not None and ratios[best] > 0.0 else None


def _ratio(told: Mapping[str, Any]) -> float:
    """Size over standard error, 0 where either is unknown."""
    size, error = _number(told.get("size")), _number(told.get("standard_error"))
    return size / error if size > 0.0 and error > 0.0 else 0.0


def _from_forcing(diagnosis: Mapping[str, Any]) -> str | None:
    forcing = diagnosis.get("forcing")
    entries = forcing if isinstance(forcing, list) else []
    return next((str(entry["state"]) for entry in entries if _mapping(entry).get("state")), None)


def _from_findings(diagnosis: Mapping[str, Any]) -> str | None:
    """Of the first finding: a state of its own, or the one in whose rate it acts."""
    findings = diagnosis.get("findings") or []
    first = _mapping(findings[0]) if findings else {}
    if first.get("state"):
        return str(first["state"])
    places = [str(place) for place in first.get("channels") or ()]
    return next((place.removeprefix(_RATE) for place in places if place.startswith(_RATE)), None)


def _mapping(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _number(value: object) -> float:
    """0 for what is no finite number."""
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return float(value) if is_number and math.isfinite(float(value)) else 0.0  # type: ignore[arg-type]
