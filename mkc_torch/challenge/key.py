"""The key of a recording: its hidden physics, and how detectable it is."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True)
class KeyParameter:
    """True value of a parameter that a diagnosis may report.

    ``value`` is that of the best linear approximation of the effect. ``scored`` is false if that approximation is
    too coarse for an interval around it to be meaningful.
    """

    name: str
    value: Any
    unit: str
    scored: bool


@dataclass(frozen=True)
class KeyRival:
    """Another explanation; ``z_sep`` is the number of standard errors by which the data reject it.

    ``at`` names its ports, if the simulation has several.
    """

    effect: str
    drivers: tuple[str, ...]
    z_sep: float
    at: tuple[str, ...] = ()


@dataclass(frozen=True)
class KeyEffect:
    """One hidden effect.

    ``drivers`` are its columns; empty if it has none or its driver is withheld. ``at`` are the ports of which a
    diagnosis has to name one; empty if the simulation has a single port.
    """

    effect: str
    form: str
    drivers: tuple[str, ...]
    withheld: str
    onset: float | None
    size: float
    parameters: tuple[KeyParameter, ...]
    z: float
    z_sep: float
    rival: KeyRival | None
    inseparable: tuple[KeyRival, ...]
    at: tuple[str, ...] = ()


@dataclass(frozen=True)
class Key:
    """Everything about a recording that the diagnosis does not get.

    ``kind`` is ``empty``, ``single``, ``double`` or ``outside`` (of the catalogue). ``mode`` is the kind of recording,
    ``norm``, ``gyro`` or ``attitude``, or the name of a system. Outliers are sample numbers. ``sensor`` holds the true
    parameters of the sensor or the system. ``oracle_rms`` is the residual on the inliers of the second recording of a
    fit that knows the effect's form and the noise: in µT, or in standard deviations of a system's errors.
    """

    name: str
    kind: str
    mode: str
    effects: tuple[KeyEffect, ...]
    noise: Mapping[str, Any]
    outlier_kind: Mapping[str, Any]
    outliers: tuple[int, ...]
    second_outliers: tuple[int, ...]
    decoys: Mapping[str, str]
    sensor: Mapping[str, Any]
    field_strength: float
    oracle_rms: float
    columns: tuple[str, ...] = field(default=())

    def numbers(self) -> dict[str, Any]:
        """Return the key as JSON data."""
        return json.loads(json.dumps(asdict(self)))


def canonical(keys: Sequence[Any]) -> str:
    """Return the canonical text of keys, which are dataclasses: JSON without spaces, with sorted names.

    Example:
        >>> canonical([])
        '[]'
    """
    return json.dumps([asdict(key) for key in keys], sort_keys=True, separators=(",", ":"), allow_nan=False)


def digest(text: str) -> str:
    """Return the SHA-256 of the UTF-8 text, in hexadecimal."""
    return hashlib.sha256(text.encode()).hexdigest()


def key_from(numbers: Mapping[str, Any]) -> Key:
    """Read a key from JSON data.

    Example:
        >>> effect = KeyEffect("hard_iron_step", "", (), "", 4.0, 1.0, (), 9.0, 8.0, None, ())
        >>> key = Key("a", "single", "norm", (effect,), {}, {}, (1,), (), {}, {}, 50.0, 0.5)
        >>> key_from(key.numbers()) == key
        True
    """
    plain = dict(numbers)
    for name in ("outliers", "second_outliers", "columns"):
        plain[name] = tuple(plain[name])
    plain["effects"] = tuple(_effect_from(effect) for effect in plain["effects"])
    return Key(**plain)


def _effect_from(numbers: Mapping[str, Any]) -> KeyEffect:
    plain = dict(numbers)
    plain["drivers"] = tuple(plain["drivers"])
    plain["at"] = tuple(plain.get("at", ()))
    plain["parameters"] = tuple(KeyParameter(**parameter) for parameter in plain["parameters"])
    plain["rival"] = _rival_from(plain["rival"]) if plain["rival"] else None
    plain["inseparable"] = tuple(_rival_from(rival) for rival in plain["inseparable"])
    return KeyEffect(**plain)


def _rival_from(numbers: Mapping[str, Any]) -> KeyRival:
    return KeyRival(numbers["effect"], tuple(numbers["drivers"]), numbers["z_sep"], tuple(numbers.get("at", ())))
