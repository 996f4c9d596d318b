"""Spellings of units, and their conversion to the canonical unit of a quantity."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from fractions import Fraction
from types import MappingProxyType
from typing import NamedTuple

CANONICAL: Mapping[str, str] = MappingProxyType(
    {
        "time": "s",
        "mag": "µT",
        "field": "µT",
        "gyro": "rad/s",
        "accel": "m/s²",
        "position": "m",
        "temperature": "°C",
        "current": "A",
        "q": "1",
    }
)
"""Canonical unit of each quantity."""


class Conversion(NamedTuple):
    """Conversion to the canonical unit: ``value * factor + shift``.

    Attributes:
        unit: name of the unit in messages, such as ``gauss``.
        factor: exact factor.
        shift: added after the factor is applied.
    """

    unit: str
    factor: Fraction
    shift: float = 0.0

    @property
    def power(self) -> int | None:
        """The exponent if the conversion is a power of ten, else None."""
        if self.shift:
            return None
        for power in range(-12, 13):
            if self.factor == Fraction(10) ** power:
                return power
        return None


_Words = Mapping[str, tuple["Fraction | int | float", str]]
_MAG: _Words = {
    "µT": (1, "ut utesla microtesla microteslas æt âut \ufffdt ?t 10^-6t 1e-6t"),
    "nT": (Fraction(1, 1000), "nt ntesla nanotesla nanoteslas"),
    "mT": (1000, "mt mtesla millitesla milliteslas"),
    "tesla": (10**6, "t tesla teslas"),
    "gauss": (100, "g ga gs gauss"),
    "milligauss": (Fraction(1, 10), "mg mga mgs mgauss milligauss"),
}
_WORDS: Mapping[str, _Words] = {
    "time": {
        "s": (1, "s sec secs second seconds"),
        "ms": (Fraction(1, 10**3), "ms msec msecs milli millis millisecond milliseconds"),
        "µs": (Fraction(1, 10**6), "us usec usecs micro micros microsecond microseconds"),
        "ns": (Fraction(1, 10**9), "ns nsec nsecs nano nanos nanosecond nanoseconds nanosec"),
        "min": (60, "min mins minute minutes"),
        "h": (3600, "h hr hrs hour hours"),
        "days": (86_400, "d day days"),
    },
    "mag": _MAG,
    "field": _MAG,
    "gyro": {
        "rad/s": (1, "rad/s rads rad/sec rad*s^-1 rads^-1 rads-1 radps"),
        "mrad/s": (Fraction(1, 1000), "mrad/s"),
        "°/s": (math.pi / 180.0, "°/s deg/s deg/sec degs dps degree/s degrees/s degrees/sec degs^-1"),
        "m°/s": (math.pi / 180e3, "mdps mdeg/s"),
    },
    "accel": {
        "m/s²": (1, "m/s2 m/s^2 m/s/s m/s/sec m*s^-2 ms^-2 ms-2 mss mps2 ms2"),
        "g": (Fraction(980665, 10**5), "g gn"),
        "mg": (Fraction(980665, 10**8), "mg milli-g"),
    },
    "position": {"m": (1, "m meter meters metre metres"), "cm": (Fraction(1, 100), "cm"),
                 "mm": (Fraction(1, 1000), "mm")},
    "temperature": {"°C": (1, "°c c degc celsius deg_c degreec centigrade"), "K": (1, "k kelvin"),
                    "°F": (Fraction(5, 9), "°f f degf fahrenheit")},
    "current": {"A": (1, "a amp amps ampere amperes"), "mA": (Fraction(1, 1000), "ma milliamp milliampere"),
                "cA": (Fraction(1, 100), "ca")},
    "q": {"1": (1, "1")},
}  # fmt: skip
_SHIFTS = {"K": -273.15, "°F": -160.0 / 9.0}

_EVERY = {word for units in _WORDS.values() for _, words in units.values() for word in words.split()}


def conversion(quantity: str, text: str) -> Conversion | None:
    """Find the conversion of a unit; None if the unit is unknown.

    Args:
        quantity: a key of :data:`CANONICAL`.
        text: the unit as written in a file or by a user.

    Example:
        >>> conversion("mag", "mGauss").unit, conversion("time", "us").factor, conversion("mag", "counts")
        ('milligauss', Fraction(1, 1000000), None)
    """
    word = _tidied(text)
    for unit, (factor, words) in _WORDS.get(quantity, {}).items():
        if word in words.split() or text.strip() == unit:
            return Conversion(unit, Fraction(factor), _SHIFTS.get(unit, 0.0))
    return None


def is_unit(text: str) -> bool:
    """Whether a text is a unit of any quantity, with or without brackets; ``counts`` and similar labels too.

    Example:
        >>> [is_unit(text) for text in ("[uT]", "°/s", "(LSB)", "mag_x", "1")]
        [True, True, True, False, True]
    """
    word = _tidied(re.sub(r"^\s*[\[({<](.*)[\])}>]\s*$", r"\1", text))
    return word in _EVERY or word in _LABELS


_LABELS = {"counts", "count", "lsb", "raw", "adc", "1", "v", "volt", "volts", "mv", "pa", "hpa", "mbar", "%", "deg",
           "°", "rad", "hz", "rpm", "m/s", "km/h", "w", "n", "nm", "kg", "j"}  # fmt: skip
"""Units of other quantities, by which a row of units is recognised."""


def known_units(quantity: str) -> str:
    """The known units of a quantity, as text for a message."""
    return ", ".join(_WORDS.get(quantity, {}))


def factors(quantity: str) -> dict[str, float]:
    """The known units of a quantity, as typed on a keyboard, and their factors to its canonical unit.

    Example:
        >>> factors("accel")["g"], list(factors("mag"))
        (9.80665, ['uT', 'nT', 'mT', 'tesla', 'gauss', 'mG'])
    """
    typed = {"µT": "uT", "milligauss": "mG", "m/s²": "m/s2"}
    return {typed.get(unit, unit): float(factor) for unit, (factor, _) in _WORDS.get(quantity, {}).items()}


def _tidied(text: str) -> str:
    """Normalise the spelling of a unit: micro signs, blanks, superscripts, capitals.

    A µ may be garbled by a wrong encoding: æT, ÂµT, �T. Capitals carry no information because megatesla and
    megaseconds do not occur.
    """
    text = text.strip().replace("μ", "u").replace("µ", "u").replace("º", "°").replace("²", "^2").replace("⁻¹", "^-1")
    text = text.replace("⁻²", "^-2").replace("·", "*").replace("⋅", "*").replace("**", "^")
    return re.sub(r"\s+", "", text).lower().replace("s^2", "s2") if "/" in text else re.sub(r"\s+", "", text).lower()
