"""Compare two runs of the gate: recordings whose verdict, findings, sizes or residual differ."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

MOVED_ERRORS = 0.5
"""A parameter counts as moved beyond this multiple of its stored standard error."""

MOVED_SHARE = 0.02
"""A parameter without a standard error, or a residual, counts as moved beyond this share of its stored value."""


def differences(stored: Mapping[str, Any], found: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return the differences of each recording by its name; recordings in only one of the runs are left out.

    Args:
        stored, found: the ``recordings`` of two runs.

    Example:
        >>> differences({"a": {"verdict": "unfit"}}, {"a": {"verdict": "adequate"}, "b": {}})
        {'a': ['verdict unfit -> adequate']}
    """
    pairs = {name: _differing(stored[name], found[name]) for name in stored if name in found}
    return {name: changes for name, changes in pairs.items() if changes}


def _differing(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    changes = [
        f"{key} {old.get(key)} -> {new.get(key)}" for key in ("verdict", "right") if old.get(key) != new.get(key)
    ]
    before, after = _names(old), _names(new)
    if before != after:
        changes.append(f"findings {', '.join(before) or 'none'} -> {', '.join(after) or 'none'}")
    else:
        changes += _moved_parameters(old, new)
    changes += [
        f"residual of {output} {residual:.4g} -> {new['residual_after'][output]:.4g}"
        for output, residual in old.get("residual_after", {}).items()
        if _moved(residual, new.get("residual_after", {}).get(output), None)
    ]
    return changes


def _names(row: Mapping[str, Any]) -> list[str]:
    """Findings with grade, channels and drivers, strongest first."""
    return [
        f"{entry['effect']} ({entry['grade']}; {', '.join([*(entry['channels'] or ()), *(entry['drivers'] or ())])})"
        for entry in row.get("findings", ())
    ]


def _moved_parameters(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    changes = []
    for before, after in zip(old.get("findings", ()), new.get("findings", ()), strict=True):
        there = {parameter["name"]: parameter["value"] for parameter in after["parameters"]}
        for p in before["parameters"]:
            value = there.get(p["name"])
            if _moved(p["value"], value, p["standard_error"]):
                changes.append(f"{p['name']} of {before['effect']} {p['value']:.4g} -> {value:.4g}")
    return changes


def _moved(old: Any, new: Any, error: Any) -> bool:
    """Whether a number moved; lists of numbers and missing values are not compared."""
    if not all(isinstance(value, (int, float)) for value in (old, new)):
        return False
    allowed = MOVED_ERRORS * error if isinstance(error, (int, float)) else MOVED_SHARE * abs(old)
    return abs(new - old) > allowed
