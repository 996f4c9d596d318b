"""Decode messages of ROS 1 and ROS 2 to numbers, by the definitions in their file.

rosbags parses the definitions. Messages are decoded here, because the deserialiser of rosbags executes code generated
from the definition, and nothing from a received file may be executed.

Sources: wiki.ros.org/msg (ROS 1 serialisation), OMG DDS-XTypes 1.3, 7.4.1 (plain CDR, XCDR1, as ROS 2 writes it).
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

from mkc_torch.recording.formats.message_rows import Cell
from mkc_torch.recording.formats.ros_units import ROS_UNITS
from mkc_torch.recording.formats.topics import MOST_ELEMENTS

Definitions = Mapping[str, Any]
"""Message type to its constants and fields, in the form of rosbags."""

TIME = "builtin_interfaces/msg/Time"
DURATION = "builtin_interfaces/msg/Duration"

_SIZES = {
    "bool": "?",
    "byte": "b",
    "char": "B",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
_DEEPEST = 32
_MOST_STEPS = 4096
"""Most values and nested messages in a message; nested definitions can expand a few bytes without limit."""


class _Field(NamedTuple):
    """A field of a message.

    Attributes:
        name: name of the field.
        kind: a primitive, "string", or the name of a message type.
        nested: True if ``kind`` is a message type.
        many: None for a single value, 0 for a sequence, else the length of the array.
    """

    name: str
    kind: str
    nested: bool
    many: int | None


def parsed_definitions(text: str, name: str, idl: bool = False) -> Definitions:
    """Parse the definitions in a ``.msg`` or ``.idl`` text, including the definition of ``name``.

    Raises:
        Exception: any error of rosbags over an invalid text.
    """
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    return get_types_from_idl(text) if idl else get_types_from_msg(text, name)


@cache
def known_definitions() -> Definitions:
    """The definitions of ROS 2's standard message types, for files without definitions."""
    from rosbags.typesys import Stores, get_typestore

    return dict(get_typestore(Stores.LATEST).fielddefs)


def type_name(name: str) -> str:
    """The full name of a type: ``sensor_msgs/Imu`` becomes ``sensor_msgs/msg/Imu``."""
    parts = name.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else name


class RosReader:
    """Decoder of messages of a type.

    Args:
        name: name of the type.
        definitions: definitions of the type and of its nested types.
        ros1: True for the serialisation of ROS 1, False for CDR.

    Raises:
        ValueError: a type has no definition, or contains itself.
    """

    def __init__(self, name: str, definitions: Definitions, ros1: bool = False) -> None:
        self._ros1 = ros1
        self._types: dict[str, list[_Field]] = {}
        self._name = type_name(name)
        self._define(self._name, definitions, ())
        self.units = self._units()

    def read(self, data: bytes) -> dict[str, Cell]:
        """Decode a message; each time is a number in ns; sequences of messages are left out.

        Raises:
            struct.error, ValueError: the bytes are not a message of this type.
        """
        if self._ros1:
            cursor = _Cursor(data, 0, "<", False)
        else:
            if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
                raise ValueError("The message is not plain CDR.")
            cursor = _Cursor(data, 4, "<" if data[1] else ">", True)
        values: dict[str, Cell] = {}
        self._read(self._name, "", cursor, values)
        return values

    def _define(self, name: str, definitions: Definitions, above: tuple[str, ...]) -> None:
        if name in above or len(above) > _DEEPEST:
            raise ValueError(f"The message type {name} contains itself.")
        if name in self._types or name in (TIME, DURATION):
            return
        if name not in definitions:
            raise ValueError(f"There is no definition of the message type {name}.")
        self._types[name] = [_field(key, description) for key, description in definitions[name][1]]
        for field in self._types[name]:
            if field.nested:
                self._define(field.kind, definitions, (*above, name))

    def _read(self, name: str, prefix: str, cursor: _Cursor, values: dict[str, Cell] | None) -> None:
        cursor.step()
        for field in self._types[name]:
            key = prefix + field.name
            count = cursor.number("I") if field.many == 0 else field.many
            if count is None:
                self._read_value(field, key, cursor, values)
            elif field.nested or field.kind == "string":
                # sequences are skipped: their length changes from message to message
                into = values if field.many and field.nested and count <= MOST_ELEMENTS else None
                for place in range(count):
                    self._read_value(field, f"{key}[{place}]", cursor, into)
                if field.kind == "string" and values is not None:
                    values[key] = ""
            else:
                found = cursor.numbers(_SIZES[field.kind], count)
                if values is not None:
                    values[key] = found

    def _read_value(self, field: _Field, key: str, cursor: _Cursor, values: dict[str, Cell] | None) -> None:
        found: Cell
        cursor.step()
        if field.kind in (TIME, DURATION):
            seconds = cursor.number("I" if self._ros1 and field.kind == TIME else "i")
            found = 1_000_000_000 * seconds + cursor.number("i" if self._ros1 and field.kind == DURATION else "I")
        elif field.nested:
            self._read(field.kind, f"{key}.", cursor, values)
            return
        elif field.kind == "string":
            found = cursor.text()
        else:
            found = cursor.number(_SIZES[field.kind])
        if values is not None:
            values[key] = found

    def _units(self) -> dict[str, str]:
        units: dict[str, str] = {}
        left = [(self._name, "")]
        for name, prefix in left:
            units |= {prefix + key: unit for key, unit in ROS_UNITS.get(name, {}).items()}
            for field in self._types.get(name, ()) if len(left) < _MOST_STEPS else ():
                if field.kind in (TIME, DURATION) and field.many is None:
                    units[prefix + field.name] = "ns"
                elif field.nested and field.many is None:
                    left.append((field.kind, f"{prefix}{field.name}."))
        return units


def _field(name: str, description: Any) -> _Field:
    """Convert rosbags' description of a field: (node kind, (name, bound)) or (node kind, (description, length))."""
    node, value = int(description[0]), description[1]
    count: int | None = None
    if node in (3, 4):  # an array of a known length, a sequence
        inner, length = value
        count = length if node == 3 else 0
        node, value = int(inner[0]), inner[1]
    kind = value if node == 2 else value[0]
    if node == 1 and kind not in _SIZES and kind != "string":
        raise ValueError(f"Fields of the kind {kind} are not read.")
    return _Field(name, kind, node == 2, count)


class _Cursor:
    """A position in a message's bytes; CDR aligns each number to its size, counted after its four-byte header."""

    __slots__ = ("_aligned", "_begin", "_data", "_order", "_place", "_steps")

    def __init__(self, data: bytes, begin: int, order: str, aligned: bool) -> None:
        self._data, self._begin, self._place, self._order, self._aligned = data, begin, begin, order, aligned
        self._steps = 0

    def step(self) -> None:
        """Count a nested value or message, and check the limit."""
        self._steps += 1
        if self._steps > _MOST_STEPS:
            raise ValueError(f"More than {_MOST_STEPS} values and messages within a message.")

    def number(self, code: str) -> Any:
        return self._take(1, code)[0]

    def numbers(self, code: str, count: int) -> tuple[Any, ...]:
        """Read ``count`` numbers; more than a row can hold are skipped and returned as zeros."""
        if count <= MOST_ELEMENTS:
            return self._take(count, code) if count else ()
        self._align(code)
        self._place += count * struct.calcsize("<" + code)
        if self._place > len(self._data):
            raise ValueError("The message ends within an array.")
        return (0,) * (MOST_ELEMENTS + 1)

    def text(self) -> str:
        length = self.number("I")
        end = self._place + length
        if end > len(self._data):
            raise ValueError("The message ends within a text.")
        found = self._data[self._place : end]
        self._place = end
        return found.rstrip(b"\0").decode("utf-8", "replace")

    def _align(self, code: str) -> None:
        if self._aligned:
            size = struct.calcsize("<" + code)
            self._place += -(self._place - self._begin) % size

    def _take(self, count: int, code: str) -> tuple[Any, ...]:
        self._align(code)
        layout = f"{self._order}{count}{code}"
        found = struct.unpack_from(layout, self._data, self._place)
        self._place += struct.calcsize(layout)
        return found
