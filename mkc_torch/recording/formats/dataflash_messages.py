"""Message formats of ArduPilot's DataFlash logs: layouts by format letters, and units.

Source: ArduPilot, libraries/AP_Logger/LogStructure.h (letters of formats, UNIT, MULT, FMTU) and README.md, also for the
units of logs from before 2018, which do not state them.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from mkc_torch.recording.formats.base import UsualUnit


class MessageFormat(NamedTuple):
    """The layout of a kind of message.

    Attributes:
        name: name of the message, such as ``MAG``.
        letters: a format letter for each column.
        columns: names of the columns.
        length: length of a message in bytes, including three bytes of header.
    """

    name: str
    letters: str
    columns: tuple[str, ...]
    length: int

    @property
    def dtype(self) -> np.dtype[np.void]:
        """The layout of a message's body; without fields if letters, columns and length are inconsistent."""
        fields = [(column, _LAYOUT[letter]) for letter, column in zip(self.letters, self.columns, strict=False)]
        layout = np.dtype(fields)
        fits = len(self.letters) == len(self.columns) and layout.itemsize == self.length - 3
        return layout if fits else np.dtype([])

    def numbers(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """The columns of rows of this layout, in the units of the log, with arrays split into ``name[i]``."""
        columns: dict[str, np.ndarray] = {}
        for letter, name in zip(self.letters, self.columns, strict=True):
            values = rows[name]
            if letter in DIVIDED:
                values = values / DIVIDED[letter]
            if values.ndim == 2:
                columns |= {f"{name}[{place}]": values[:, place] for place in range(values.shape[1])}
            else:
                columns[name] = values
        return columns


_LAYOUT: dict[str, object] = {
    "a": ("<i2", (32,)),
    "b": "i1",
    "B": "u1",
    "g": "<f2",
    "h": "<i2",
    "H": "<u2",
    "i": "<i4",
    "I": "<u4",
    "f": "<f4",
    "d": "<f8",
    "n": "S4",
    "N": "S16",
    "Z": "S64",
    "c": "<i2",
    "C": "<u2",
    "e": "<i4",
    "E": "<u4",
    "L": "<i4",
    "M": "u1",
    "q": "<i8",
    "Q": "<u8",
}
TEXT = frozenset("nNZ")
WHOLE = frozenset("bBhHiIMqQ")
DIVIDED: Mapping[str, float] = {"c": 1e2, "C": 1e2, "e": 1e2, "E": 1e2, "L": 1e7}
"""Divisors of letters whose whole numbers are fractions of the unit; dividing rounds correctly, unlike factor 1e-7."""

MESSAGE_FORMAT = MessageFormat("FMT", "BBnNZ", ("Type", "Length", "Name", "Format", "Columns"), 89)
"""The format of the messages that define formats."""

_PREFIXES = {1.0: "", 1e-1: "d", 1e-2: "c", 1e-3: "m", 1e-6: "µ", 1e-9: "n", 1e3: "k"}

_LEGACY = {
    "MAG": dict.fromkeys(("MagX", "MagY", "MagZ", "OfsX", "OfsY", "OfsZ", "MOX", "MOY", "MOZ"), "mGauss")
    | {f"MOfs{axis}": "mGauss" for axis in "XYZ"},
    "IMU": {f"Gyr{axis}": "rad/s" for axis in "XYZ"} | {f"Acc{axis}": "m/s/s" for axis in "XYZ"},
    "ATT": dict.fromkeys(("DesRoll", "Roll", "DesPitch", "Pitch", "DesYaw", "Yaw"), "deg"),
    "BAT": {"Volt": "V", "Curr": "A"},
    "BARO": {"Alt": "m", "Press": "Pa", "Temp": "degC"},
}
"""Units that are the same in all versions of ArduPilot, for logs that do not state units."""


def message_format(kind: int, length: int, name: str, letters: str, columns: str) -> MessageFormat | None:
    """The format that the fields of an FMT message define; None if they are invalid."""
    names = tuple(column.strip() for column in columns.split(",")) if columns else ()
    if not 0 <= kind <= 255 or not 3 <= length <= 255 or not name.isprintable() or not name:
        return None
    if set(letters) - set(_LAYOUT) or len(set(names)) < len(names) or not all(names):
        return MessageFormat(name, "", (), length)
    return MessageFormat(name, letters, names, length)


def units_of(
    message: MessageFormat,
    unit_ids: str,
    multiplier_ids: str,
    units: Mapping[str, str],
    multipliers: Mapping[str, float],
) -> dict[str, str]:
    """The units of a message's columns: those that the log states, or ArduPilot's constant units.

    Args:
        message: the format of the message.
        unit_ids, multiplier_ids: letters of the message's FMTU, one for each column; empty without an FMTU.
        units, multipliers: contents of the log's UNIT and MULT messages, by letter.

    Example:
        >>> mag = MessageFormat("MAG", "Qh", ("TimeUS", "MagX"), 13)
        >>> units_of(mag, "sG", "FC", {"s": "s", "G": "Gauss"}, {"F": 1e-6, "C": 1e-3})
        {'TimeUS': 'µs', 'MagX': 'mGauss'}
        >>> units_of(mag, "", "", {}, {})
        {'TimeUS': 'us', 'MagX': 'mGauss'}
    """
    found = {}
    legacy = _LEGACY.get(message.name.rstrip("0123456789"), {}) if not unit_ids else {}
    for place, (letter, column) in enumerate(zip(message.letters, message.columns, strict=True)):
        unit = units.get(unit_ids[place : place + 1], "")
        if unit and letter not in DIVIDED:
            multiplier = float(f"{multipliers.get(multiplier_ids[place : place + 1], 1.0):.7g}")
            # zero stands for "none" and −1 for "unknown"
            unit = f"{_PREFIXES[multiplier]}{unit}" if multiplier in _PREFIXES else "" if multiplier > 0 else unit
        if not unit:
            unit = UsualUnit({"TimeUS": "us", "TimeMS": "ms"}.get(column, legacy.get(column, "")))
        if unit and unit not in ("instance", "UNKNOWN"):
            found[column] = unit
    return found


def instance_column(message: MessageFormat, unit_ids: str) -> str | None:
    """The column with the sensor's index, ``#`` in FMTU, or ``I`` in older logs; None if there is no such column."""
    place = unit_ids.find("#")
    if 0 <= place < len(message.columns):
        return message.columns[place]
    if not unit_ids and "I" in message.columns and message.letters[message.columns.index("I")] == "B":
        return "I"
    return None


def c_text(field: bytes | str) -> str:
    """Text up to its first zero byte."""
    return (field if isinstance(field, str) else field.decode("utf-8", "replace")).partition("\0")[0]


def definition(body: bytes) -> MessageFormat | None:
    """The format that the body of a binary FMT message defines."""
    kind, length, name, letters, columns = struct.unpack("<BB4s16s64s", body)
    return message_format(kind, length, c_text(name), c_text(letters), c_text(columns))
