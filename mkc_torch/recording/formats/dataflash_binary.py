"""Read the messages of a binary ArduPilot DataFlash log (``.bin``).

This does not use pymavlink, which reads message by message, silently drops everything after a message of an unknown
kind, prints a line for each skipped byte, and brings 90 MB of telemetry code. The tests compare with pymavlink.
"""

from __future__ import annotations

import mmap
from array import array
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mkc_torch.recording.formats.base import Topic, listed
from mkc_torch.recording.formats.damage import lost_warning
from mkc_torch.recording.formats.dataflash_messages import MESSAGE_FORMAT, MessageFormat, c_text, definition
from mkc_torch.recording.formats.dataflash_topics import DEFINITIONS, statements, topics_of_message

_MAGIC = b"\xa3\x95"
_FMT = 0x80
_FILLING = (b"\x00", b"\xff")
"""Bytes of erased pages at the end of a log."""


class _Messages(NamedTuple):
    """The offsets of the messages.

    Attributes:
        found: message number, format and offsets in bytes; a redefined number has a separate entry.
        lost: number of bytes that belong to no message.
        last_whole: offset in bytes at which the last complete message ends.
    """

    found: list[tuple[int, MessageFormat, array[int]]]
    lost: int
    last_whole: int


def read_binary(path: Path) -> tuple[list[Topic], list[str]]:
    """Read the topics of a log, and warnings about its lost parts.

    The file is memory-mapped; the memory needed is twice the size of its measurements.
    """
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        messages = _walk(content)
        columns = [(kind, message, _columns(content, message, places)) for kind, message, places in messages.found]
        size = len(content)
    by_name = {
        message.name: {name: _cells(values) for name, values in found.items()}
        for _, message, found in columns
        if message.name in DEFINITIONS
    }
    stated = statements(by_name)
    topics = [
        topic
        for kind, message, found in columns
        if message.name not in DEFINITIONS and found
        for topic in topics_of_message(kind, message, found, stated)
    ]
    warnings = []
    if messages.lost:
        where = "its end" if messages.last_whole + messages.lost == size else "several places"
        warnings.append(lost_warning(messages.lost, size, where))
    unreadable = sorted({message.name for _, message, found in columns if not found})
    if unreadable:
        warnings.append(f"The log does not define the layout of {listed(unreadable)}; these messages are left out.")
    return topics, warnings


def _walk(content: mmap.mmap) -> _Messages:
    found: list[tuple[int, MessageFormat, array[int]]] = [(_FMT, MESSAGE_FORMAT, array("Q"))]
    places: list[array[int] | None] = [None] * 256
    lengths = [0] * 256
    places[_FMT], lengths[_FMT] = found[0][2], MESSAGE_FORMAT.length
    formats: dict[int, MessageFormat] = {_FMT: MESSAGE_FORMAT}
    size, place, lost, last_whole, in_step = len(content), 0, 0, 0, True
    while place + 3 <= size:
        kind = content[place + 2]
        length = lengths[kind]
        end = place + length
        # after damage the two header bytes may be part of a measurement: another header must follow
        whole = length and end <= size and content[place : place + 2] == _MAGIC
        if whole and (in_step or end == size or content[end : end + 2] == _MAGIC):
            here = places[kind]
            assert here is not None
            here.append(place)
            if kind == _FMT and (new := definition(content[place + 3 : end])):
                number = content[place + 3]
                if formats.get(number) != new and number != _FMT:
                    formats[number], lengths[number] = new, new.length
                    places[number] = offsets = array("Q")
                    found.append((number, new, offsets))
            place = last_whole = end
            in_step = True
            continue
        following = content.find(_MAGIC, place + 1)
        following = size if following < 0 else following
        lost += following - place
        place, in_step = following, False
    lost += size - place
    if content[last_whole:].strip(_FILLING[0]) == b"" or content[last_whole:].strip(_FILLING[1]) == b"":
        lost -= size - last_whole
    return _Messages([entry for entry in found if entry[2]], lost, last_whole)


def _columns(content: mmap.mmap, message: MessageFormat, places: array[int]) -> dict[str, np.ndarray]:
    """The columns of the messages of a kind; empty if its layout is unknown."""
    layout = message.dtype
    if not layout.itemsize:
        return {}
    body = np.frombuffer(content, np.uint8)
    begins = np.frombuffer(places, np.uint64).astype(np.int64) + 3
    rows = np.empty((len(begins), layout.itemsize), np.uint8)
    step = max(1, 2**22 // layout.itemsize)  # the index of a block is eight times the block
    for begin in range(0, len(begins), step):
        block = begins[begin : begin + step, None] + np.arange(layout.itemsize)
        rows[begin : begin + step] = body[block]
    del body  # the memory map cannot be closed while an array refers to it
    return message.numbers(rows.view(layout)[:, 0])


def _cells(values: np.ndarray) -> list[object]:
    return [c_text(cell) if isinstance(cell, bytes) else cell for cell in values.tolist()]
