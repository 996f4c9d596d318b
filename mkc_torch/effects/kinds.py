"""The kind of quantity of a state, an input or an output, from its unit and its name."""

from __future__ import annotations

from typing import Literal

from mkc_torch.effects.context import Context

Kind = Literal["temperature", "angle", "rotation", "position", "speed", "level", "voltage", "current", "pressure", ""]
"""Kind of a quantity; empty if not known."""

MOTION: tuple[Kind, ...] = ("angle", "rotation", "position", "speed")
"""The mechanical kinds."""

CELSIUS = ("°C", "degC", "deg_C", "celsius", "Celsius")
"""Ways to write degrees Celsius."""

_FAHRENHEIT = ("°F", "degF")
"""Ways to write degrees Fahrenheit."""

_LEAST_KELVIN = 150.0
"""Mean above which a temperature without a unit is in K."""

_JOINTS = "angle base elbow flex hip joint knee lift pan pitch roll shoulder tilt wrist yaw"
"""Words in the names of joint angles."""

_UNITS: dict[str, Kind] = {
    **dict.fromkeys((*CELSIUS, "K", "degK", "kelvin", "°F", "degF"), "temperature"),
    **dict.fromkeys(("rad", "°", "deg"), "angle"),
    **dict.fromkeys(("rad/s", "°/s", "deg/s", "rpm", "1/min"), "rotation"),
    **dict.fromkeys(("m", "mm", "cm", "km", "µm"), "position"),
    **dict.fromkeys(("m/s", "mm/s", "cm/s", "km/h"), "speed"),
    **dict.fromkeys(("V", "mV"), "voltage"),
    **dict.fromkeys(("A", "mA"), "current"),
    **dict.fromkeys(("Pa", "hPa", "kPa", "MPa", "bar", "mbar"), "pressure"),
}

_NAMES: dict[str, Kind] = {
    **dict.fromkeys(("temp", "temperature", "indoor", "outdoor", "ambient"), "temperature"),
    **dict.fromkeys(("level", "tank"), "level"),
    **dict.fromkeys(("speed", "velocity"), "speed"),
    **dict.fromkeys(_JOINTS.split(), "angle"),
    **dict.fromkeys(("voltage", "volt", "volts"), "voltage"),
    "current": "current",
    "pressure": "pressure",
}

_LEVELS: tuple[Kind, ...] = ("position", "voltage", "current", "")
"""Kinds of the units of level sensors; a name with "level" takes precedence over them."""


def kind_of(unit: str, name: str = "") -> Kind:
    """The kind of a quantity by its unit; by its name where the unit is empty, or where the name is a level's.

    Args:
        unit: unit in the recording or the simulation.
        name: name of the column or the state.

    Example:
        >>> kind_of("degC"), kind_of("", "temp_2"), kind_of("V", "level1"), kind_of("V"), kind_of("", "x")
        ('temperature', 'temperature', 'level', 'voltage', '')
    """
    known = _UNITS.get(unit, "")
    words = [word.rstrip("0123456789") for word in name.lower().split("_")]
    named: list[Kind] = [_NAMES[word] for word in words if word in _NAMES]
    if "level" in named and known in _LEVELS:
        return "level"
    return known or (named[0] if named and not unit else "")


def kind_at(context: Context) -> Kind:
    """The kind of the quantity an effect acts on; a length without a speed is a level.

    At the rate of a state it is the kind of the state, at an input or an output that of the input or output.
    """
    name = context.parts.get("own", context.channels[0] if context.channels else "")
    kind = kind_of(context.part_units.get("own", context.signal_unit), name)
    return "level" if kind == "position" and "level" in context.parts else kind


def absolute_zero(unit: str, mean: float) -> float:
    """The offset that makes a temperature with this mean absolute; °F becomes absolute in degrees Rankine.

    Without a unit a temperature is in °C if its mean is below 150, otherwise in K.

    Example:
        >>> absolute_zero("K", 20.0), absolute_zero("", 20.0), absolute_zero("", 300.0), absolute_zero("°F", 70.0)
        (0.0, 273.15, 0.0, 459.67)
    """
    if unit in _FAHRENHEIT:
        return 459.67
    return zero_of(unit) if unit else 273.15 * (mean < _LEAST_KELVIN)


def zero_of(unit: str) -> float:
    """The offset in K that makes a temperature in this unit absolute.

    Example:
        >>> zero_of("°C"), zero_of("degC"), zero_of("K")
        (273.15, 273.15, 0.0)
    """
    return 273.15 if unit in CELSIUS else 0.0
