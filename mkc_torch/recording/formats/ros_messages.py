"""Messages of ROS 1 and ROS 2 as numbers, by the definition that their file holds.

rosbags parses the definitions. The messages are read here, and not by its deserialiser, because that executes code
which it writes from the definition: nothing of a file that somebody sent is executed.

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

__all__ = ["Definitions", "RosReader", "known_definitions", "parsed_definitions"]

Definitions = Mapping[str, Any]
"""Names of message types to their constants and fields, as rosbags has them."""

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
"""Messages within a message; definitions can nest so that a few bytes stand for any number of them."""


class _Field(NamedTuple):
    """A field: a primitive's name, "string", or a type's name; ``many`` None of one value, 0 of a sequence."""

    name: str
    kind: str
    nested: bool
    many: int | None


def parsed_definitions(text: str, name: str, idl: bool = False) -> Definitions:
    """The definitions in a text, of ``.msg`` or ``.idl``, that of ``name`` among them.

    Raises:
        Exception: as rosbags does, where the text is none.
    """
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    return get_types_from_idl(text) if idl else get_types_from_msg(text, name)


@cache
def known_definitions() -> Definitions:
    """The definitions of the message types that come with ROS 2, for files that hold none."""
    from rosbags.typesys import Stores, get_typestore

    return dict(get_typestore(Stores.LATEST).fielddefs)


def type_name(name: str) -> str:
    """The name of a type with its ``msg``: ``sensor_msgs/Imu`` is ``sensor_msgs/msg/Imu``."""
    parts = name.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else name


class RosReader:
    """Reads messages of one type.

    Args:
        name: of the type.
        definitions: that of the type, and of those in it.
        ros1: the serialisation: that of ROS 1, or CDR.

    Raises:
        ValueError: a type without a definition, or one that contains itself.
    """

    def __init__(self, name: str, definitions: Definitions, ros1: bool = False) -> None:
        self._ros1 = ros1
        self._types: dict[str, list[_Field]] = {}
        self._name = type_name(name)
        self._define(self._name, definitions, ())
        self.units = self._units()

    def read(self, data: bytes) -> dict[str, Cell]:
        """The values of a message; times in ns, one number each; sequences of messages are left out.

        Raises:
            struct.error, ValueError: the bytes are none of a message of this type.
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
        self._types[name] = [_field(one, description) for one, description in definitions[name][1]]
        for field in self._types[name]:
            if field.nested:
                self._define(field.kind, definitions, (*above, name))

    def _read(self, name: str, prefix: str, cursor: _Cursor, values: dict[str, Cell] | None) -> None:
        cursor.step()
        for field in self._types[name]:
            key = prefix + field.name
            count = cursor.number("I") if field.many == 0 else field.many
            if count is None:
                self._read_one(field, key, cursor, values)
            elif field.nested or field.kind == "string":
                # those of a sequence are passed over: their number changes from message to message
                into = values if field.many and field.nested and count <= MOST_ELEMENTS else None
                for place in range(count):
                    self._read_one(field, f"{key}[{place}]", cursor, into)
                if field.kind == "string" and values is not None:
                    values[key] = ""
            else:
                found = cursor.numbers(_SIZES[field.kind], count)
                if values is not None:
                    values[key] = found

    def _read_one(self, field: _Field, key: str, cursor: _Cursor, values: dict[str, Cell] | None) -> None:
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
    """A field from rosbags' description of it: (kind of node, (name, bound)) or (kind, (description, length))."""
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
    """A place in a message's bytes; CDR aligns each number to its size, from behind its four bytes of header."""

    __slots__ = ("_aligned", "_begin", "_data", "_order", "_place", "_steps")

    def __init__(self, data: bytes, begin: int, order: str, aligned: bool) -> None:
        self._data, self._begin, self._place, self._order, self._aligned = data, begin, begin, order, aligned
        self._steps = 0

    def step(self) -> None:
        """One message within the message more."""
        self._steps += 1
        if self._steps > _MOST_STEPS:
            raise ValueError(f"More than {_MOST_STEPS} messages within one.")

    def number(self, code: str) -> Any:
        return self._take(1, code)[0]

    def numbers(self, code: str, count: int) -> tuple[Any, ...]:
        """That many numbers; of more than a row can have, their places alone are passed over."""
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
