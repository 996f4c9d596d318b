"""Read MCAP files (``.mcap``) by the package mcap, with messages of ROS 1, ROS 2, JSON and Protocol Buffers.

Source: mcap.dev/spec, and its registry of well-known encodings.
"""

from __future__ import annotations

import contextlib
import io
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from mkc_torch.recording.formats.base import FileFormat, RecordingError, Topic
from mkc_torch.recording.formats.compression import inflated
from mkc_torch.recording.formats.damage import guarded, lost_warning, no_rows, with_warnings
from mkc_torch.recording.formats.magic_numbers import check_begins
from mkc_torch.recording.formats.message_decoders import json_values, protobuf_reader
from mkc_torch.recording.formats.message_log import MessageLog
from mkc_torch.recording.formats.message_rows import Cell
from mkc_torch.recording.formats.ros_messages import RosReader, known_definitions, parsed_definitions, type_name

_MAGIC = b"\x89MCAP0\r\n"
_INSTALL = 'MCAP files are read with mcap and rosbags; install them with `pip install "mkc-torch[mcap]"`.'


class _State(NamedTuple):
    schemas: dict[int, Any]
    channels: dict[int, Any]
    log: MessageLog
    source: object


def read(path: Path) -> list[Topic]:
    """Read the topics of a file: nested fields with dots, arrays ``[i]``, times in ns (``header.stamp``, ``log_time``).

    The file is read record by record. Memory is eight bytes per number plus two chunks of the file. Messages larger
    than 64 KiB, such as images, are skipped. All complete messages of a truncated file are read, also those in its
    last, incomplete chunk.

    Raises:
        RecordingError: the file is not an MCAP file, or has no readable message.
        ImportError: mcap or rosbags is not installed.
    """
    log = MessageLog()
    warnings = gather_mcap(path, log)
    topics, left_out = log.topics()
    if not topics:
        raise no_rows(path, "MCAP file", [*warnings, *left_out])
    return with_warnings(topics, [*warnings, *left_out])


def gather_mcap(path: Path, log: MessageLog) -> list[str]:
    """Add the messages of a file to a log; returns warnings about lost parts."""
    check_begins(path, "MCAP file", _MAGIC)
    try:
        import mcap.stream_reader  # noqa: F401 - tests whether it is installed
        import rosbags.typesys  # noqa: F401 - tests whether it is installed
    except ImportError as error:
        raise ImportError(_INSTALL) from error
    size = path.stat().st_size
    state = _State({}, {}, log, path)
    with guarded(path, "MCAP file"), path.open("rb") as file:
        read_to, broken, wrong = 0, 0, 0
        for record, place in _records(file, size):
            read_to = place
            if type(record).__name__ == "Chunk":
                data = inflated(record.compression, record.data, record.uncompressed_size)
                broken += not _chunk(data, record.uncompressed_size, state)
                if record.uncompressed_crc and len(data) == record.uncompressed_size:
                    wrong += zlib.crc32(data) != record.uncompressed_crc
            else:
                _take(record, state)
    warnings = []
    if read_to < size:
        warnings.append(lost_warning(size - read_to, size, f"its end, from byte {read_to:,} on", "cannot be read"))
    if broken:
        warnings.append(f"The file is damaged or cut off: {broken} of its chunks could be read only in part.")
    if wrong:
        warnings.append(
            f"The file is damaged: the checksum of {wrong} of its chunks is wrong; numbers there may be wrong too."
        )
    return warnings


def _records(file: io.BufferedReader, size: int) -> Iterator[tuple[Any, int]]:
    """Yield each record and the offset of its end, up to the footer or the first unreadable record."""
    from mcap.data_stream import ReadDataStream
    from mcap.opcode import Opcode
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader

    reader = StreamReader(file, emit_chunks=True, record_size_limit=size)
    place = len(_MAGIC)
    try:
        for record in reader.records:
            place = size if type(record).__name__ == "Footer" else file.tell()
            yield record, place
        return
    except Exception:  # the truncated record of a damaged file; records before it are kept
        file.seek(place)
    head = file.read(9)
    if head[:1] == bytes([Opcode.CHUNK]):
        with contextlib.suppress(Exception):
            half = Chunk.read(ReadDataStream(file))
            yield half, size


def _chunk(data: bytes, size: int, state: _State) -> bool:
    """Add the records of a chunk of ``size`` bytes to the log; returns whether all records were readable."""
    from mcap.stream_reader import StreamReader

    stream = io.BytesIO(data)
    end = 0
    try:
        for record in StreamReader(stream, skip_magic=True, record_size_limit=len(data)).records:
            _take(record, state)
            end = stream.tell()
    except Exception:  # also raised at the regular end of the chunk
        return end == len(data) == size
    return end == len(data) == size


def _take(record: Any, state: _State) -> None:
    match type(record).__name__:
        case "Schema":
            state.schemas[record.id] = record
        case "Channel":
            if (state.source, record.id) not in state.log and record.id not in state.channels:
                _open(record, state)
            state.channels[record.id] = record
        case "Message":
            state.log.add((state.source, record.channel_id), record.data, record.log_time, record.publish_time)


def _open(channel: Any, state: _State) -> None:
    schema = state.schemas.get(channel.schema_id)
    name = schema.name if schema else ""
    try:
        read, units = _reader(channel.message_encoding, schema)
    except ImportError as error:
        state.log.leave_out(channel.topic, str(error).rstrip("."))
    except Exception as error:  # parsers raise arbitrary errors over a damaged definition
        reason = str(error).strip().splitlines() or [type(error).__name__]
        state.log.leave_out(channel.topic, f"its messages, of {name or 'no type'}, cannot be read ({reason[0][:100]})")
    else:
        state.log.open((state.source, channel.id), channel.topic, name, read, units)


def _reader(encoding: str, schema: Any) -> tuple[Callable[[bytes], Mapping[str, Cell]], Mapping[str, str]]:
    if encoding == "json":
        return json_values, {}
    if schema is None:
        raise ValueError(f"they are encoded as {encoding}, without a schema")
    if encoding == "protobuf" and schema.encoding == "protobuf":
        try:
            return protobuf_reader(schema), {}
        except ImportError as error:
            raise ImportError(_INSTALL) from error
    if encoding in ("cdr", "ros1"):
        text = schema.data.decode("utf-8", "replace")
        found = (
            parsed_definitions(text, type_name(schema.name), idl=schema.encoding == "ros2idl") if text.strip() else {}
        )
        ros1 = encoding == "ros1"
        reader = RosReader(schema.name, found if ros1 else {**known_definitions(), **found}, ros1)
        return reader.read, reader.units
    raise RecordingError(f"they are encoded as {encoding}, which is not supported")


MCAP = FileFormat((".mcap",), read)
