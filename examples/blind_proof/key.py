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
class KeyDisturbance:
    """An unrecorded disturbance.

    Attributes:
        kind: name of the scenario with such disturbances.
        at: the state whose rate is disturbed, or ``sensor``.
        size: standard deviation in ``unit``; for white process noise the square root of its spectral density.
        over_noise: RMS of the residual that it causes in the fitted open-loop run, over the sensor's noise.
        words: further numbers by name, such as times in s.
    """

    kind: str
    at: str
    size: float
    unit: str
    over_noise: float
    words: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Key:
    """Everything about a recording that the diagnosis does not get.

    ``kind`` is ``empty``, ``single``, ``double``, ``outside`` (of the catalogue) or ``useless`` (the simulation).
    ``mode`` is the kind of recording, ``norm``, ``gyro`` or ``attitude``, or the name of a system. Outliers are sample
    numbers. ``sensor`` holds the true parameters of the sensor or the system. ``oracle_rms`` is the residual on the
    inliers of the second recording of a fit that knows the effect's form and the noise: in µT, or in standard
    deviations of a system's errors. ``index`` counts the cases of a ``scenario`` with hidden physics, or those without.
    ``useless`` is why the simulation is unusable, "" for a usable one; ``explained`` is the largest share of an
    output's variation that the best fit of an unusable simulation explains.
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
    columns: tuple[str, ...] = ()
    scenario: str = ""
    index: int = 0
    disturbance: KeyDisturbance | None = None
    useless: str = ""
    explained: float | None = None

    def numbers(self) -> dict[str, Any]:
        """Return the key as JSON data."""
        return json.loads(json.dumps(asdict(self)))


def canonical(keys: Sequence[Key]) -> str:
    """Return the canonical text of keys: JSON without spaces, with sorted names.

    Example:
        >>> canonical([])
        '[]'
    """
    return json.dumps([asdict(key) for key in keys], sort_keys=True, separators=(",", ":"), allow_nan=False)


def digest(text: str) -> str:
    """Return the SHA-256 of the UTF-8 text, in hexadecimal."""
    return hashlib.sha256(text.encode()).hexdigest()
