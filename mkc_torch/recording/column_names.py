"""Parse the name of a column into quantity, axis, sensor and unit."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import NamedTuple

from mkc_torch.recording.unit_words import CANONICAL, conversion

_STRONG = {
    "mag": {
        "mag",
        "mags",
        "magn",
        "magnet",
        "magnetometer",
        "magnetic",
        "magneto",
        "magfield",
        "compass",
        "magnetfeld",
        "hmc",
        "qmc",
        "bmm",
        "mmc",
    },
    "gyro": {"gyro", "gyr", "gyroscope", "angularvelocity", "angularrate", "rotationrate", "omega"},
    "accel": {"accel", "acc", "acce", "accelerometer", "acceleration", "linearacceleration"},
    "q": {"q", "quat", "quaternion", "orientation", "attitude"},
}
_WEAK = {"mag": {"m", "b", "h"}, "gyro": {"g", "w"}, "accel": {"a"}}
"""Letters that stand for a quantity if an axis follows: mx, Bx, gx, ax."""

_AXES = {"mag": "xyz", "gyro": "xyz", "accel": "xyz", "q": "wxyz"}
_OTHERS = {
    "heading", "yaw", "pitch", "roll", "declination", "decl", "inclination", "bias", "offset", "offsets", "ofs",
    "scale", "gain", "std", "stddev", "sigma", "var", "variance", "cov", "covariance", "norm", "magnitude", "total",
    "strength", "abs", "absolute", "ref", "reference", "earth", "expected", "model", "status", "error", "fit",
    "predicted", "estimate", "estimated", "est", "innov", "innovation", "count", "ratio", "test", "user", "gravity",
    "delta", "setpoint", "sp",
    "accuracy", "residual", "true", "truth", "free", "rate", "ekf", "id", "valid", "angle", "lin", "pos", "position",
}  # fmt: skip
"""Words that mark another quantity: an estimate, an expected value, or a derived value."""

_TIME_UNITS = {"millis", "micros", "seconds", "milliseconds", "microseconds", "nanoseconds"}
_TIME = {
    "utc", "time", "timestamp", "timestamps", "stamp", "datetime", "zeit", "zeitstempel", "uhrzeit", "temps", "tow",
    "itow", *_TIME_UNITS,
}  # fmt: skip
_TIME_FILLERS = {
    "header", "utc", "sample", "boot", "ros", "log", "logging", "logger", "elapsed", "since", "epoch", "unix", "system",
    "sys", "sensor", "recorded", "local", "gps", "date", "iso", "field", "and", "of", "reboot", "start",
    "1970", "rosbag", "rel", "relative", "host", "device",
}  # fmt: skip
_SCALARS = {"temperature": {"temperature", "temp"}, "current": {"current", "curr"}}
_SCALAR_FILLERS = {"imu", "sensor", "mag", "magnetometer", "battery", "bat", "batt", "board", "chip", "value", "field"}

_UNIT = re.compile(r"^(.*?\S)\s*[\[({<]\s*([^\])}>]*?)\s*[\])}>]$")
_TOKEN = re.compile(r"[A-Z]+(?![a-zµμ])|[A-Z]?[a-zäöüß]+|\d+|[µμ°]\w*")
_GLUED = re.compile(r"(?<=[XYZxyz])(uT|nT|mT|µT|μT|mG|mGauss|Gauss|dps)$|(?<=[a-z])(Us|Ms|Ns|US|MS|NS)$")
_ONE_LETTER = {"time": "s", "mag": "TG", "accel": "gG", "current": "Aa", "temperature": "CcKF"}
"""Units of one letter that a name may end with; capitals matter."""


class Meaning(NamedTuple):
    """The parsed name of a column.

    Attributes:
        quantity: mag, gyro, accel, q, temperature, current or time.
        axis: w, x, y or z; empty for a scalar.
        sensor: the name without axis and unit, such as ``mag0``.
        unit: the unit as written; empty if the name has no unit.
        sure: False if the quantity is a single letter, as in ``mx``.
    """

    quantity: str
    axis: str
    sensor: str
    unit: str
    sure: bool

    @property
    def column(self) -> str:
        """The canonical name of such a column, such as ``mag_x``."""
        return f"{self.quantity}_{self.axis}" if self.axis else self.quantity


def split_unit(name: str) -> tuple[str, str]:
    """Split a name from the unit in brackets behind it.

    Example:
        >>> split_unit("magX [uT]"), split_unit("MAG[0].x (gauss)"), split_unit("q[0]")
        (('magX', 'uT'), ('MAG[0].x', 'gauss'), ('q[0]', ''))
    """
    found = _UNIT.match(name.strip())
    if found is None or found[2].isdigit() or not found[2]:
        return name.strip(), ""
    return found[1], found[2]


def is_derived(name: str) -> bool:
    """Whether a word of a name marks an estimate, an expected value, or a derived value.

    Example:
        >>> is_derived("field offset X [uT]"), is_derived("Feld X [uT]")
        (True, False)
    """
    return any(word.lower() in _OTHERS for word in _TOKEN.findall(split_unit(name)[0]))


def meaning(name: str) -> Meaning | None:
    """Parse the name of a column; None if it is not recognised.

    Example:
        >>> meaning("magX [uT]")
        Meaning(quantity='mag', axis='x', sensor='mag', unit='uT', sure=True)
        >>> meaning("magnetometer_ga[2]")[:4], meaning("time_us")[::3], meaning("mag_heading")
        (('mag', 'z', 'magnetometer', 'ga'), ('time', 'us'), None)
    """
    plain, unit = split_unit(name)
    glued = _GLUED.search(plain)
    if glued and not unit and not plain.isupper():
        plain, unit = plain[: glued.start()], glued[0]
    index = re.search(r"[\[(](\d)[\])]$", plain)
    words = _TOKEN.findall(plain[: index.start()] if index else plain)
    if not words:
        return None
    for tail in range(0 if unit else min(3, len(words) - 1), -1, -1):
        rest, end = words[: len(words) - tail], words[len(words) - tail :]
        found = _classified([word.lower() for word in rest], int(index[1]) if index else None)
        if found is not None and not tail:
            return found._replace(unit=unit or _unit_of_time(found, rest))
        for unit_text in ("/".join(end), "".join(end)):
            if found is not None and conversion(found.quantity, unit_text) and _is_unit_of(found, unit_text):
                return found._replace(unit=unit_text)
    return None


def _is_unit_of(found: Meaning, unit_text: str) -> bool:
    """Whether the end of a name is its unit; a single letter must have the capitals of a unit."""
    return len(unit_text) > 1 or unit_text in _ONE_LETTER.get(found.quantity, "")


def _unit_of_time(found: Meaning, words: list[str]) -> str:
    """The unit of a time whose name contains it, such as Arduino's millis and micros, or seconds_elapsed."""
    units = [word.lower() for word in words if word.lower() in _TIME_UNITS]
    if found.quantity == "time" and any(word.lower() == "itow" for word in words):
        return "ms"  # of UBX and other GNSS receivers
    return units[0] if found.quantity == "time" and units else ""


def _classified(words: list[str], index: int | None) -> Meaning | None:
    """The meaning of words without a unit, given the index in brackets behind them."""
    for axis, rest in _axes(words, index):
        joined = _joined(rest)
        if _OTHERS & set(joined):
            continue
        for quantity, strong in _STRONG.items():
            if axis is not None and (found := _of_vector(quantity, joined, strong, axis)):
                return found
    if index is None:
        return _of_scalar(words)
    return None


def _of_vector(quantity: str, words: list[str], strong: set[str], axis: str) -> Meaning | None:
    hits = [word for word in words if word in strong]
    weak = not hits and len(words) <= 2 and words[:1] and words[0] in _WEAK.get(quantity, set())
    others = any(word in names for other, names in _STRONG.items() if other != quantity for word in words)
    if not (hits or weak) or (others and quantity != "mag"):
        return None
    if axis.isdigit():
        axis = _AXES[quantity][int(axis)] if int(axis) < len(_AXES[quantity]) else ""
    if axis not in _AXES[quantity] or not axis:
        return None
    if weak and len(words) == 2 and not words[1].isdigit():
        return None
    return Meaning(quantity, axis, _sensor(words), "", not weak)


def _axes(words: list[str], index: int | None) -> Iterable[tuple[str | None, list[str]]]:
    """Yield each possible axis with the remaining words: an index, a separate word, or a first or last letter."""
    if index is not None:
        yield str(index), words
    for i, word in enumerate(words):
        if word in ("w", "x", "y", "z") and len(words) > 1:
            yield word, words[:i] + words[i + 1 :]
    every = set().union(*_STRONG.values(), *_WEAK.values())
    for i, word in enumerate(words):
        if word[-1:] in "wxyz" and word[:-1] in every:
            yield word[-1], [*words[:i], word[:-1], *words[i + 1 :]]
        elif word[:1] in "xyz" and len(word) > 2 and word[1:] in every:
            yield word[0], [*words[:i], word[1:], *words[i + 1 :]]


def _joined(words: list[str]) -> list[str]:
    """Join words of two parts, such as angular velocity."""
    pairs = {"angularvelocity", "angularrate", "rotationrate", "linearacceleration"}
    for i in range(len(words) - 1):
        if words[i] + words[i + 1] in pairs:
            return [*words[:i], words[i] + words[i + 1], *words[i + 2 :]]
    return words


def _sensor(words: list[str]) -> str:
    """Join words to a sensor's name: a number is appended to the word before it, and no word is repeated."""
    parts: list[str] = []
    for word in words:
        if word.isdigit() and parts:
            parts[-1] += word
        elif word not in parts and f"{word}" not in [re.sub(r"\d+$", "", part) for part in parts]:
            parts.append(word)
    return "_".join(parts)


def _of_scalar(words: list[str]) -> Meaning | None:
    if _TIME & set(words) and all(word in _TIME | _TIME_FILLERS for word in words):
        return Meaning("time", "", "_".join(words), "", True)
    if words == ["t"]:
        return Meaning("time", "", "t", "", False)
    for quantity, names in _SCALARS.items():
        if names & set(words) and all(word in names | _SCALAR_FILLERS for word in words):
            return Meaning(quantity, "", "_".join(words), "", True)
    return None


def is_about_magnetometer(name: str) -> bool:
    """Whether the name of a topic or file names a magnetometer and no other sensor.

    Example:
        >>> [is_about_magnetometer(name) for name in ("sensor_mag_0", "/imu/mag", "Magnetometer", "imu", "gyro_mag")]
        [True, True, True, False, False]
    """
    words = {word.lower() for word in _TOKEN.findall(name)}
    others = set().union(*(names for quantity, names in _STRONG.items() if quantity != "mag"))
    return bool(_STRONG["mag"] & words) and not (others | _OTHERS) & words


def form(sensor: str) -> str:
    """A sensor's name without numbers and words of position; equal for two sensors of the same kind."""
    words = [re.sub(r"\d+$", "", word) for word in sensor.split("_")]
    places = {
        "primary", "secondary", "left", "right", "front", "back", "rear", "internal", "external", "int", "ext", "l",
        "r", "a", "b",
    }  # fmt: skip
    return "_".join(word for word in words if word and word not in places)


assert set(_AXES) <= set(CANONICAL)
