"""Conversion of units from the notation of FMUs."""

from __future__ import annotations

import re

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_NAMES = {"1": "", "-": "", "degC": "°C", "deg": "°", "Ohm": "Ω"}
_POWER = re.compile(r"(?<=[A-Za-zΩµ°])\^?\(?(-?\d+)\)?")


def unit_of(text: str | None) -> str:
    """A unit in Modelica's notation, "kg.m2/s", in the notation of this package; empty for None.

    Example:
        >>> unit_of("kg.m2/s"), unit_of("m/s2"), unit_of("N.m"), unit_of("degC"), unit_of("1"), unit_of(None)
        ('kg·m²/s', 'm/s²', 'N·m', '°C', '', '')
    """
    words = (text or "").strip()
    if words in _NAMES:
        return _NAMES[words]
    raised = _POWER.sub(lambda found: found[1].translate(_RAISED), words)
    parts = re.split(r"([./*()])", raised.replace(" ", "."))
    return "".join({".": "·", "*": "·"}.get(part, _NAMES.get(part, part) if part != "1" else "1") for part in parts)
