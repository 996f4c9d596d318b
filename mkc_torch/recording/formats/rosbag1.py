"""Read ROS 1 bags (``.bag``), format 2.0.

The records are read here, because rosbags rejects a bag that was not closed. A recorder that loses its power writes no
index, but its messages are complete.

Source: wiki.ros.org/Bags/Format/2.0.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from mkc_torch.recording.formats.base import FileFormat, RecordingError, Topic, optional
from mkc_torch.recording.formats.compression import inflated
from mkc_torch.recording.formats.damage import guarded, lost_warning, no_rows, with_warnings
from mkc_torch.recording.formats.magic_numbers import check_begins
from mkc_torch.recording.formats.message_log import MessageLog
from mkc_torch.recording.formats.ros_messages import RosReader, parsed_definitions, type_name

_MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG, _CHUNK, _CONNECTION = b"\x02", b"\x03", b"\x05", b"\x07"
_LENGTH = struct.Struct("<I")


class _Record(NamedTuple):
    header: dict[bytes, bytes]
    data: bytes
    end: int
    whole: bool


def read(path: Path) -> list[Topic]:
    """Read the topics of a bag: nested fields with dots, arrays ``[i]``, times in ns (``header.stamp``, ``log_time``).

    The file is memory-mapped and read chunk by chunk. Memory is eight bytes per number plus a chunk of the file.
    Messages larger than 64 KiB, such as images, are skipped. A bag that was not closed, or is cut off, is read as far
    as possible.

    Raises:
        RecordingError: the file is not a ROS 1 bag, is of another version, or has no readable message.
        ImportError: rosbags is not installed.
    """
    check_begins(path, "ROS 1 bag of version 2.0", _MAGIC)
    optional("rosbags.typesys", "ROS bags", "rosbag")
    log = MessageLog()
    warnings = []
    with (
        guarded(path, "ROS 1 bag"),
        path.open("rb") as file,
        mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content,
    ):
        size, read_to, broken = len(content), len(_MAGIC), 0
        for record in _records(content, read_to):
            kind = record.header.get(b"op")
            if kind == _CHUNK:
                broken += not _chunk(record, log)
                read_to = record.end
            elif record.whole:
                _take(record, log)
                read_to = record.end
                if kind == _BAG and record.header.get(b"encryptor", b""):
                    raise RecordingError(f"{path}: the bag is encrypted; decrypt it first.")
    if read_to < size:
        where = f"its end, from byte {read_to:,} on"
        warnings.append(lost_warning(size - read_to, size, where, "cannot be read"))
    if broken:
        warnings.append(f"The bag is damaged or cut off: {broken} of its chunks could be read only in part.")
    topics, left_out = log.topics()
    if not topics:
        raise no_rows(path, "ROS 1 bag", [*warnings, *left_out])
    return with_warnings(topics, [*warnings, *left_out])


def _records(content: mmap.mmap | bytes, place: int) -> Iterator[_Record]:
    """Yield the records of a bag or a chunk up to invalid bytes; the last record may be incomplete."""
    size = len(content)
    while place + 8 <= size:
        (length,) = _LENGTH.unpack_from(content, place)
        begin = place + 4 + length
        if begin + 4 > size:
            return
        header = _header(content[place + 4 : begin])
        if header is None:
            return
        (length,) = _LENGTH.unpack_from(content, begin)
        end = min(begin + 4 + length, size)
        whole = end == begin + 4 + length
        yield _Record(header, content[begin + 4 : end], end, whole)
        place = end


def _header(data: bytes) -> dict[bytes, bytes] | None:
    """The fields ``name=value`` of a header; None if the header is invalid."""
    fields: dict[bytes, bytes] = {}
    place = 0
    while place + 4 <= len(data):
        (length,) = _LENGTH.unpack_from(data, place)
        name, equals, value = data[place + 4 : place + 4 + length].partition(b"=")
        place += 4 + length
        if not equals or place > len(data):
            return None
        fields[name] = value
    return fields if b"op" in fields and place == len(data) else None


def _chunk(chunk: _Record, log: MessageLog) -> bool:
    """Add the records of a chunk to the log; returns whether all records were readable."""
    size = chunk.header.get(b"size", b"")
    if len(size) != 4:
        return False
    (length,) = _LENGTH.unpack(size)
    data = inflated(chunk.header.get(b"compression", b"").decode("ascii", "replace"), chunk.data, length)
    end = 0
    for record in _records(data, 0):
        if record.whole:
            _take(record, log)
            end = record.end
    return end == length


def _take(record: _Record, log: MessageLog) -> None:
    kind, connection = record.header[b"op"], record.header.get(b"conn")
    if kind == _CONNECTION and connection not in log:
        _open(record, log)
    elif kind == _MESSAGE and len(stamp := record.header.get(b"time", b"")) == 8:
        seconds, nanoseconds = struct.unpack("<II", stamp)
        log.add(connection, record.data, 1_000_000_000 * seconds + nanoseconds)


def _open(record: _Record, log: MessageLog) -> None:
    fields = _header(_LENGTH.pack(4) + b"op=\0" + record.data) or {}
    topic = record.header.get(b"topic", b"").decode("utf-8", "replace")
    kind = fields.get(b"type", b"").decode("utf-8", "replace")
    text = fields.get(b"message_definition", b"").decode("utf-8", "replace")
    try:
        reader = RosReader(kind, parsed_definitions(text, type_name(kind)), ros1=True)
    except Exception as error:  # the parser raises arbitrary errors over a damaged definition
        lines = str(error).strip().splitlines() or [type(error).__name__]
        log.leave_out(topic, f"its messages, of {kind or 'no type'}, cannot be read ({lines[0][:100]})")
    else:
        log.open(record.header.get(b"conn"), topic, kind, reader.read, reader.units)


ROSBAG1 = FileFormat((".bag",), read)
