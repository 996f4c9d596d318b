"""What the name of a column says: the quantity, the axis, which of several sensors, and the unit."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import NamedTuple

from mkc_torch.recording.unit_words import CANONICAL, conversion

__all__ = ["Meaning", "is_about_magnetometer", "meaning", "split_unit"]

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
"""Letters that stand for a quantity where an axis follows them: mx, Bx, gx, ax."""

_AXES = {"mag": "xyz", "gyro": "xyz", "accel": "xyz", "q": "wxyz"}
_OTHERS = {
    "heading", "yaw", "pitch", "roll", "declination", "decl", "inclination", "bias", "offset", "offsets", "ofs",
    "scale", "gain", "std", "stddev", "sigma", "var", "variance", "cov", "covariance", "norm", "magnitude", "total",
    "strength", "abs", "absolute", "ref", "reference", "earth", "expected", "model", "status", "error", "fit",
    "predicted", "estimate", "estimated", "est", "innov", "innovation", "count", "ratio", "test", "user", "gravity",
    "delta", "setpoint", "sp",
    "accuracy", "residual", "true", "truth", "free", "rate", "ekf", "id", "valid", "angle", "lin", "pos", "position",
}  # fmt: skip
"""Words that make another quantity of one: what is estimated, expected, or derived from it."""

_FILLERS = {
    "field", "raw", "sensor", "imu", "data", "value", "values", "val", "measured", "measurement", "reading", "body",
    "frame", "vector", "vec", "axis", "component", "motion", "device", "msg", "message", "uncalibrated", "uncal",
    "calibrated", "cal", "calib", "corrected", "si",
}  # fmt: skip
"""Words that say nothing of which sensor it is, or only in which form."""

_TIME_UNITS = {"millis", "micros", "seconds", "milliseconds", "microseconds", "nanoseconds"}
_TIME = {
    "utc",
    "time",
    "timestamp",
    "timestamps",
    "stamp",
    "datetime",
    "zeit",
    "zeitstempel",
    "uhrzeit",
    "temps",
    "tow",
    "itow",
    *_TIME_UNITS,
}
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
"""Units of one letter that a name may end with, as they are written."""


class Meaning(NamedTuple):
    """What a name says.

    Attributes:
        quantity: mag, gyro, accel, q, temperature, current or time.
        axis: w, x, y or z; empty where there is none.
        sensor: what the name is without quantity's axis and unit, such as ``mag0``.
        unit: as it is written; empty where the name has none.
        sure: False of a single letter such as ``mx`` has.
    """

    quantity: str
    axis: str
    sensor: str
    unit: str
    sure: bool

    @property
    def column(self) -> str:
        """The name that such a column has here."""
        return f"{self.quantity}_{self.axis}" if self.axis else self.quantity


def split_unit(name: str) -> tuple[str, str]:
    """A name and the unit in brackets behind it.

    Example:
        >>> split_unit("magX [uT]"), split_unit("MAG[0].x (gauss)"), split_unit("q[0]")
        (('magX', 'uT'), ('MAG[0].x', 'gauss'), ('q[0]', ''))
    """
    found = _UNIT.match(name.strip())
    if found is None or found[2].isdigit() or not found[2]:
        return name.strip(), ""
    return found[1], found[2]


def meaning(name: str) -> Meaning | None:
    """What the name of a column says; None where it is not known.

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
        for told in ("/".join(end), "".join(end)):
            if found is not None and conversion(found.quantity, told) and _is_unit_of(found, told):
                return found._replace(unit=told)
    return None


def _is_unit_of(found: Meaning, told: str) -> bool:
    """Whether the end of a name is its unit: a single letter is only where it is written as units are."""
    return len(told) > 1 or told in _ONE_LETTER.get(found.quantity, "")


def _unit_of_time(found: Meaning, words: list[str]) -> str:
    """Arduino's millis and micros, and seconds_elapsed, are units by themselves."""
    told = [word.lower() for word in words if word.lower() in _TIME_UNITS]
    if found.quantity == "time" and any(word.lower() == "itow" for word in words):
        return "ms"  # of UBX and other GNSS receivers
    return told[0] if found.quantity == "time" and told else ""


def _classified(words: list[str], index: int | None) -> Meaning | None:
    """The meaning of words without a unit, and of the index in brackets behind them."""
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
    """The ways of taking an axis off: an index, a word of its own, or the letter that a word begins or ends with."""
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
    """Words with those of two parts as one: angular velocity."""
    pairs = {"angularvelocity", "angularrate", "rotationrate", "linearacceleration"}
    for i in range(len(words) - 1):
        if words[i] + words[i + 1] in pairs:
            return [*words[:i], words[i] + words[i + 1], *words[i + 2 :]]
    return words


def _sensor(words: list[str]) -> str:
    """Words as one name, a number with the word before it, and none twice."""
    told: list[str] = []
    for word in words:
        if word.isdigit() and told:
            told[-1] += word
        elif word not in told and f"{word}" not in [re.sub(r"\d+$", "", one) for one in told]:
            told.append(word)
    return "_".join(told)


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
    """Whether a topic or a file is called after a magnetometer, and after no other sensor.

    Example:
        >>> [is_about_magnetometer(name) for name in ("sensor_mag_0", "/imu/mag", "Magnetometer", "imu", "gyro_mag")]
        [True, True, True, False, False]
    """
    words = {word.lower() for word in _TOKEN.findall(name)}
    others = set().union(*(names for quantity, names in _STRONG.items() if quantity != "mag"))
    return bool(_STRONG["mag"] & words) and not (others | _OTHERS) & words


def form(sensor: str) -> str:
    """A sensor's name without numbers and words of place: what two of one kind have in common."""
    words = [re.sub(r"\d+$", "", word) for word in sensor.split("_")]
    places = {
        "primary",
        "secondary",
        "left",
        "right",
        "front",
        "back",
        "rear",
        "internal",
        "external",
        "int",
        "ext",
        "l",
        "r",
        "a",
        "b",
    }
    return "_".join(word for word in words if word and word not in places)


assert set(_AXES) <= set(CANONICAL)
