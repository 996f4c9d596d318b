"""Units as text: normal forms, quotients and conversion factors."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

_RAISED = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
_POWERS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
_FACTOR = re.compile(r"(?P<name>[^\d⁻⁰¹²³⁴⁵⁶⁷⁸⁹^]+)\^?(?P<power>[-⁻]?[\d⁰¹²³⁴⁵⁶⁷⁸⁹]+)?$")


_PREFIXES = {"": 1.0, "n": 1e-9, "µ": 1e-6, "u": 1e-6, "m": 1e-3, "c": 1e-2, "k": 1e3}
_BASE = {f"{prefix}{name}": (size, name) for name in "TAVmsK" for prefix, size in _PREFIXES.items()}
_BASE |= {"°C": (1.0, "K"), "G": (1e-4, "T"), "mG": (1e-7, "T"), "gauss": (1e-4, "T"), "°": (1.0, "°")}
"""Units with their factors to base units, and these base units."""

_SYMBOLS = {*"NmsgAVWJKCFHTΩ", "kg", "rad", "Pa", "Hz", "mm", "cm", "°C"}
"""Symbols between which a space stands for a product."""

_PLAIN = -3, 6
"""Powers of ten between which a number has no exponent."""


def sized(value: float, unit: str = "") -> str:
    """A number to four digits with its unit, for an equation.

    Example:
        >>> sized(-0.12345, "m"), sized(2.5e-7), sized(3.0)
        ('−0.1235 m', '2.5 × 10⁻⁷', '3')
    """
    power = math.floor(math.log10(abs(value))) if value and math.isfinite(value) else 0
    if _PLAIN[0] <= power < _PLAIN[1]:
        number = f"{value:.4g}"
    else:
        number = f"{value / 10.0**power:.4g} × 10{str(power).replace('-', '⁻').translate(_POWERS)}"
    return f"{number} {unit}".rstrip().replace("-", "−", 1) if value < 0 else f"{number} {unit}".rstrip()


def duration(seconds: float) -> str:
    """A time to two digits in s, min, h or d, whichever suits its size.

    Example:
        >>> duration(0.0312), duration(95.0), duration(420.0), duration(7560.0), duration(260000.0)
        ('0.031 s', '95 s', '7 min', '2.1 h', '3 d')
    """
    for limit, size, unit in _TIMES:
        if abs(seconds) < limit:
            return sized(float(f"{seconds / size:.2g}"), unit)
    return sized(float(f"{seconds / _DAY:.2g}"), "d")


_DAY = 86400.0
_TIMES = (120.0, 1.0, "s"), (7200.0, 60.0, "min"), (2.0 * _DAY, 3600.0, "h")
"""Upper limit in s of the times in a unit, the length of the unit in s, and the unit."""


def share_of(value: float) -> str:
    """A share in percent, or from 2 on as a multiple.

    Example:
        >>> share_of(0.382), share_of(3.14)
        ('38 %', '3.1 times the size')
    """
    percent = value < 2.0
    number = sized(float(f"{100.0 * value if percent else value:.2g}"))
    return f"{number} %" if percent else f"{number} times the size"


def tidy(unit: str) -> str:
    """A unit with each factor once; unchanged if it is not a product of powers.

    Example:
        >>> tidy("rad/s/s"), tidy("m/(s·kg)"), tidy("1/s"), tidy("°C"), tidy(""), tidy("N m s/rad")
        ('rad/s²', 'm/(s·kg)', '1/s', '°C', '', 'N m s/rad')
    """
    factors = _factors(unit)
    return unit if factors is None else _written(factors, _product_sign(unit))


def quotient(unit: str, other: str, power: int = 1) -> str:
    """The unit ``unit / other**power``, with K for a difference in °C; empty if a unit is empty or not a product.

    Example:
        >>> quotient("rad/s²", "rad/s", 2), quotient("rad/s²", "rad/s"), quotient("m/s²", "m/s", 2)
        ('1/rad', '1/s', '1/m')
        >>> quotient("W", "°C", 2), quotient("N m", "rad/s")
        ('W/K²', 'N m s/rad')
    """
    other = "K" if other == "°C" else other
    above, below = _factors(unit), _factors(other)
    if not unit or not other or above is None or below is None:
        return ""
    powers = {name: above.get(name, 0) - power * below.get(name, 0) for name in {**above, **below}}
    return _written(powers, _product_sign(unit))


def ratio(unit: str, other: str) -> float | None:
    """The factor from a unit to the other unit; None if not known.

    It is for differences: 1 °C is 1 K.

    Example:
        >>> ratio("µT/A", "nT/mA"), ratio("µT/K", "µT/°C"), ratio("µT", "V"), ratio("furlong", "furlong")
        (1.0, 1.0, None, 1.0)
    """
    if tidy(unit) == tidy(other):
        return 1.0
    sizes = [_in_base_units(text) for text in (unit, other)]
    if sizes[0] is None or sizes[1] is None or sizes[0][1] != sizes[1][1]:
        return None
    # the quotient of two powers of ten is rounded to a power of ten
    return float(f"{sizes[0][0] / sizes[1][0]:.12g}")


def _in_base_units(unit: str) -> tuple[float, dict[str, int]] | None:
    """The factor of a unit to base units, and the powers of these; None if a factor of the unit is not known."""
    factors = _factors(unit)
    if factors is None:
        return None
    size = 1.0
    powers: dict[str, int] = {}
    for name, power in factors.items():
        base = _BASE.get(name)
        if base is None:
            return None
        size *= base[0] ** power
        powers[base[1]] = powers.get(base[1], 0) + power
    return size, {name: power for name, power in powers.items() if power}


def _factors(unit: str) -> dict[str, int] | None:
    """The factors of a unit: name to power; None if it is not a product of powers."""
    factors: dict[str, int] = {}
    for place, part in enumerate(re.split(r"/", unit.strip())):
        for piece in _pieces(part.strip().removeprefix("(").removesuffix(")")):
            if piece.strip() in ("", "1"):
                continue
            found = _FACTOR.match(piece.strip())
            if found is None or " " in piece.strip() or (("(" in part) != (")" in part)):
                return None
            power = int((found["power"] or "1").translate(_RAISED))
            factors[found["name"]] = factors.get(found["name"], 0) + (power if place == 0 else -power)
    return factors


def _pieces(product: str) -> list[str]:
    spaced = product.split()
    if len(spaced) > 1 and all((found := _FACTOR.match(piece)) and found["name"] in _SYMBOLS for piece in spaced):
        return spaced
    return re.split(r"[·*]", product)


def _product_sign(unit: str) -> str:
    return " " if " " in unit.strip() else "·"


def _written(factors: Mapping[str, int], sign: str) -> str:
    above = [_raised(name, power) for name, power in factors.items() if power > 0]
    below = [_raised(name, -power) for name, power in factors.items() if power < 0]
    if not below:
        return sign.join(above)
    divisor = below[0] if len(below) == 1 else f"({sign.join(below)})"
    return f"{sign.join(above) or '1'}/{divisor}"


def _raised(name: str, power: int) -> str:
    return name if power == 1 else f"{name}{str(power).translate(_POWERS)}"
