"""Decoders of JSON and Protocol Buffers messages in MCAP files."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

from mkc_torch.recording.formats.message_rows import Cell
from mkc_torch.recording.formats.topics import MOST_ELEMENTS

_DEEPEST = 16
_TIMES = ("google.protobuf.Timestamp", "google.protobuf.Duration")


def json_values(data: bytes) -> dict[str, Cell]:
    """The numbers and texts of a JSON object, with dots between the names of nested fields.

    Times of Foxglove's schemas, ``{"sec": …, "nsec": …}``, become a number in ns.

    Raises:
        ValueError: the data is not a JSON object.

    Example:
        >>> json_values(b'{"t": {"sec": 1, "nsec": 5}, "field": {"x": 0.5}, "q": [1, 2]}')
        {'t': 1000000005, 'field.x': 0.5, 'q': (1, 2)}
    """
    found = json.loads(data)
    if not isinstance(found, dict):
        raise ValueError("A message must be an object.")
    values: dict[str, Cell] = {}
    _flatten(found, "", values, 0)
    return values


def _flatten(found: Mapping[str, Any], prefix: str, values: dict[str, Cell], depth: int) -> None:
    for name, value in found.items():
        key = f"{prefix}{name}"
        if isinstance(value, dict):
            if set(value) in ({"sec", "nsec"}, {"sec", "nanosec"}) and all(
                type(item) is int for item in value.values()
            ):
                values[key] = 1_000_000_000 * value["sec"] + value.get("nsec", value.get("nanosec", 0))
            elif depth < _DEEPEST:
                _flatten(value, f"{key}.", values, depth + 1)
        elif isinstance(value, list):
            if all(isinstance(item, int | float) for item in value):
                values[key] = tuple(value[: MOST_ELEMENTS + 1])
        elif isinstance(value, int | float | str):
            values[key] = value


def protobuf_reader(schema: Any) -> Callable[[bytes], Mapping[str, Cell]]:
    """Make a reader of the messages that an MCAP schema describes.

    Raises:
        Exception: any error of the libraries over a damaged schema.
    """
    from mcap_protobuf.decoder import DecoderFactory

    decode = DecoderFactory().decoder_for("protobuf", schema)
    if decode is None:
        raise ValueError(f"{schema.name} is not a Protocol Buffers message")

    def read(data: bytes) -> Mapping[str, Cell]:
        values: dict[str, Cell] = {}
        _fields(decode(data), "", values, 0)
        return values

    return read


def _fields(message: Any, prefix: str, values: dict[str, Cell], depth: int) -> None:
    for field in message.DESCRIPTOR.fields:
        key = f"{prefix}{field.name}"
        value = getattr(message, field.name)
        if field.message_type is None:
            if field.is_repeated:
                cells = tuple(value[: MOST_ELEMENTS + 1])
                if all(isinstance(item, int | float) for item in cells):
                    values[key] = cells
            elif isinstance(value, int | float | str):
                values[key] = value
        elif field.is_repeated:
            continue
        elif field.message_type.full_name in _TIMES:
            values[key] = 1_000_000_000 * value.seconds + value.nanos
        elif depth < _DEEPEST and (message.HasField(field.name) or depth == 0):
            _fields(value, f"{key}.", values, depth + 1)
