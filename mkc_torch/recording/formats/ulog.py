"""Read PX4 ULog files (``.ulg``) by pyulog.

Source: docs.px4.io, "ULog File Format".
"""

from __future__ import annotations

import io
import mmap
import os
import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from mkc_torch._support.note import Note
from mkc_torch.recording.formats.base import FileFormat, RecordingError, Topic, counted, optional
from mkc_torch.recording.formats.damage import guarded, lost_warning, no_rows, with_warnings
from mkc_torch.recording.formats.magic_numbers import check_begins
from mkc_torch.recording.formats.px4_calibration import magnetometer_correction
from mkc_torch.recording.formats.px4_units import px4_units
from mkc_torch.recording.formats.topics import topic_of

_MAGIC = b"ULog\x01\x12\x35"
_HEADER = 16
_MOST_FIELDS = 65536
_DEEPEST = 8
_BIASES = 4
"""Magnetometers in a message ``magnetometer_bias_estimate``."""

_LOOK = 4096
"""Reads between two checks for an endless loop."""

_MOST_READS = 4
"""Most reads per byte of the file; a message is two reads, and a step of one byte over damage is two."""

_FIELD = re.compile(r"(?P<kind>\w+)(\[(?P<count>\d{1,9})\])? ")
_KINDS = frozenset(b"BFIMPQAARDLCSO")
"""Message types of the specification; other types are damage or a later version."""


def read(path: Path) -> list[Topic]:
    """Read the topics of a log, named ``sensor_mag_0`` by instance, with PX4's names of fields.

    Fields of nested messages have dots in their names, arrays ``[i]``; ``timestamp`` is in µs. Memory is twice the
    file's size.

    Raises:
        RecordingError: the file is not a ULog, or has no complete row.
        ImportError: pyulog is not installed.
    """
    check_begins(path, "PX4 ULog", _MAGIC)
    pyulog = optional("pyulog", "ULog files", "ulog")
    with guarded(path, "PX4 ULog"), _LoopGuard(path.open("rb", buffering=0)) as file:
        walk = _walk(path)
        log = pyulog.ULog(file)
        warnings = _losses(log, walk)
        topics = [topic for data in log.data_list if (topic := _topic(data, log)) is not None]
    if not topics:
        raise no_rows(path, "PX4 ULog", warnings)
    return with_warnings(_with_unique_names(topics), warnings)


class _LoopGuard(io.BufferedReader):
    """A file that raises an error after too many reads: pyulog can step back over damage without end."""

    _reads = 0

    def read(self, size: int | None = -1, /) -> bytes:
        self._reads += 1
        if self._reads % _LOOK == 0 and self._reads > _MOST_READS * os.fstat(self.fileno()).st_size:
            raise RuntimeError("its messages form an endless loop")
        return super().read(size)


def _topic(data: Any, log: Any) -> Topic | None:
    kinds = {field.field_name: field.type_str for field in data.field_data}
    columns = {name: values for name, values in data.data.items() if not name.split(".")[-1].startswith("_padding")}
    text = sorted({name.partition("[")[0] for name in columns if kinds.get(name) == "char"})
    columns = {name: values for name, values in columns.items() if kinds.get(name) != "char"}
    first = [name for name in ("timestamp",) if name in columns]
    columns = {name: columns[name] for name in [*first, *columns]}
    warnings = [Note(f"Column `{name}` holds text and is left out.") for name in text]
    topic = topic_of(f"{data.name}_{data.multi_id}", columns, px4_units(data.name, columns), warnings)
    if topic is None:
        return None
    changed = {name for _, name, _ in log.changed_parameters}
    known = magnetometer_correction(data.name, columns, log.initial_parameters, changed, _bias_estimated(log))
    return topic._replace(correction=known)


def _bias_estimated(log: Any) -> bool:
    """Whether PX4 estimated a bias of a magnetometer and subtracted it."""
    estimates = [data.data for data in log.data_list if data.name == "magnetometer_bias_estimate"]
    names = [f"bias_{axis}[{place}]" for axis in "xyz" for place in range(_BIASES)]
    return any(bool(np.any(estimate[name])) for estimate in estimates for name in names if name in estimate)


def _with_unique_names(topics: list[Topic]) -> list[Topic]:
    """Number topics that have the same name because they ended and were logged again."""
    seen: Counter[str] = Counter()
    named = []
    for topic in topics:
        seen[topic.name] += 1
        count = seen[topic.name]
        named.append(topic if count == 1 else topic._replace(name=f"{topic.name} ({count})"))
    return named


def _losses(log: Any, walk: tuple[int, int, int]) -> list[str]:
    """Warnings about data that the logger lost, and parts of the file that cannot be read."""
    warnings = []
    if log.dropouts:
        seconds = sum(dropout.duration for dropout in log.dropouts) / 1000.0
        warnings.append(f"The logger lost {seconds:.3g} s of data in {counted(len(log.dropouts), 'dropout')}.")
    whole, rows, size = walk
    if whole < size:
        warnings.append(lost_warning(size - whole, size, "its end"))
    read_rows = sum(len(next(iter(data.data.values()))) for data in log.data_list if data.data)
    if read_rows < rows:
        warnings.append(f"The file is damaged: {rows - read_rows:,} of its {rows:,} rows cannot be read.")
    elif log.file_corruption and whole == size:
        warnings.append("The file is damaged in places; the unreadable parts are left out.")
    return warnings


def _walk(path: Path) -> tuple[int, int, int]:
    """The offset in bytes at which the complete messages end, their number of rows, and the file's size in bytes.

    pyulog stops silently at the end of a truncated file; this function walks over the headers of all messages.
    """
    size = path.stat().st_size
    if size < _HEADER:
        raise RecordingError(f"{path}: the PX4 ULog ends within its header; record it again, or copy the whole file.")
    place, rows = _HEADER, 0
    formats: dict[str, list[tuple[str, int]]] = {}
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        while place + 3 <= size:
            length = content[place] + 256 * content[place + 1]
            kind = content[place + 2]
            if place + 3 + length > size or kind not in _KINDS:
                break
            rows += kind == ord("D")
            if kind == ord("F"):
                _define(content[place + 3 : place + 3 + length], formats)
            place += 3 + length
    known: dict[str, int] = {}
    if any(_width(name, formats, known, 0) > _MOST_FIELDS for name in formats):
        raise RecordingError(f"{path}: the PX4 ULog is damaged: a message has more than {_MOST_FIELDS:,} fields.")
    return place, rows, size


def _define(text: bytes, formats: dict[str, list[tuple[str, int]]]) -> None:
    """Store the types and counts of the fields of a message format ``name:type[count] field;…``."""
    name, _, fields = text.decode("utf-8", "replace").partition(":")
    formats[name] = [
        (found["kind"], int(found["count"] or 1)) for field in fields.split(";") if (found := _FIELD.match(field))
    ]


def _width(name: str, formats: dict[str, list[tuple[str, int]]], known: dict[str, int], depth: int) -> int:
    """The number of values of a message; nested formats can have very many, and pyulog makes an object of each."""
    if name not in formats:
        return 1
    if depth > _DEEPEST:
        return _MOST_FIELDS + 1
    if name in known:
        return known[name]
    total = 0
    for kind, count in formats[name]:
        total += count * _width(kind, formats, known, depth + 1) if count else 0
        if total > _MOST_FIELDS:
            break
    known[name] = total
    return total


ULOG = FileFormat((".ulg", ".ulog"), read)
