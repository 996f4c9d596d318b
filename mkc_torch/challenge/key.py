"""The key to a recording: what was hidden in it, and how well it could be seen."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True)
class KeyParameter:
    """A number that a diagnosis may state: ``value`` is the best a linear effect could say.

    ``scored`` is false where the linear form leaves so much of the true effect unsaid that an interval around it
    means nothing.
    """

    name: str
    value: Any
    unit: str
    scored: bool


@dataclass(frozen=True)
class KeyRival:
    """Another explanation, and the number of standard deviations by which the data speak against it.

    ``at`` is where it acts, of several places that a simulation has for it.
    """

    effect: str
    drivers: tuple[str, ...]
    z_sep: float
    at: tuple[str, ...] = ()


@dataclass(frozen=True)
class KeyEffect:
    """One hidden effect.

    ``drivers`` are the columns it follows, empty where there is none or it was withheld; ``at`` the places of which a
    diagnosis has to name one, of several that a simulation has, and empty where it has one only.
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
    """What the diagnosis is not told.

    ``kind`` is ``empty``, ``single``, ``double`` or ``outside`` (of the catalogue); ``mode`` is what the recording
    offers: ``norm``, ``gyro`` or ``attitude``, or the name of a system. Outliers are sample numbers. ``sensor`` holds
    the true parameters of the sensor or the system. ``oracle_rms`` is the residual that a fit which knows the effect's
    form and the noise leaves on the second recording's good samples: in µT, or in standard deviations of a system's
    errors.
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
        """The same as JSON would have it."""
        return json.loads(json.dumps(asdict(self)))


def canonical(keys: Sequence[Any]) -> str:
    """One text for one set of keys, which are dataclasses: JSON without spaces, names in order.

    Example:
        >>> canonical([])
        '[]'
    """
    return json.dumps([asdict(key) for key in keys], sort_keys=True, separators=(",", ":"), allow_nan=False)


def digest(text: str) -> str:
    """SHA-256 of the text in UTF-8, in hexadecimal."""
    return hashlib.sha256(text.encode()).hexdigest()


def key_from(numbers: Mapping[str, Any]) -> Key:
    """A key from its JSON.

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
