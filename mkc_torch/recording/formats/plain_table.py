"""Read a long table of plain numbers at once, after its first and last lines have shown its layout.

The general reader classifies each line. If the lines between the first and the last hold nothing but numbers and
separators, and all have as many separators as the header, the result is the same, and the parser reads the body alone.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mkc_torch.recording.formats.text_layout import Layout
from mkc_torch.recording.formats.text_lines import Line

_LONG = 1_000_000
"""Smallest size in bytes for which the shorter way is tried."""

_HEAD = 400
_TAIL = 400
"""Lines at the beginning and at the end that are classified one by one."""

_LINE = 10_000
"""Most bytes of a line."""

_BLOCK = 2**22
"""Bytes of the blocks in which the separators are counted."""

_NUMBER = b"0123456789+-.eE\n"
_MISSING = b"nNaA"
_WITH_UNIT = re.compile(rb"[0-9.][nNaA]")
"""A number followed by letters, which may be a unit."""


class PlainTable(NamedTuple):
    """The layout of a plain table, the bytes of its rows, and their number."""

    layout: Layout
    body: bytes
    rows: int


def plain_table(path: Path, layout_of: Callable[[Path, list[Line]], Layout]) -> PlainTable | None:
    """The layout and the body of a long plain table; None for any other file, which needs the general reader.

    Args:
        path: the file.
        layout_of: finds the parts of a table from its lines.
    """
    if not path.is_file() or path.stat().st_size < _LONG:
        return None
    data = path.read_bytes()
    if b"\r" in data[:_LINE]:
        data = data.replace(b"\r\n", b"\n")
    data = data.removeprefix(b"\xef\xbb\xbf").removesuffix(b"\n")
    begin, end = _after_lines(data, _HEAD), _before_lines(data, _TAIL)
    if begin is None or end is None or begin >= end or not (data[:begin].isascii() and data[end:].isascii()):
        return None
    count = data.count(b"\n") + 1
    texts = [*data[:begin].decode().splitlines(), *data[end:].decode().split("\n")]
    numbers = [*range(1, _HEAD + 1), *range(count - _TAIL + 1, count + 1)]
    if len(texts) != len(numbers) or not all(text.strip() for text in texts):
        return None
    layout = layout_of(path, [Line(number, text) for number, text in zip(numbers, texts, strict=True)])
    first, last = layout.rows[0].number, layout.rows[-1].number
    whole = len(layout.rows) == len(numbers) - (first - 1) - (count - last)
    if layout.restarts or not whole or len(layout.separator) != 1 or layout.separator == " ":
        return None
    above, below = _after_lines(data, first - 1), _before_lines(data, count - last)
    if above is None or below is None:
        return None
    body = data[above : below - 1 if last < count else below]
    return PlainTable(layout, body, last - first + 1) if _is_plain(body, layout) else None


def _after_lines(data: bytes, count: int) -> int | None:
    """Position after so many lines from the beginning; None if they are not short."""
    place = 0
    for _ in range(count):
        place = data.find(b"\n", place, place + _LINE) + 1
        if not place:
            return None
    return place


def _before_lines(data: bytes, count: int) -> int | None:
    """Position of so many lines at the end; None if they are not short."""
    place = len(data)
    for _ in range(count):
        place = data.rfind(b"\n", max(0, place - _LINE), place)
        if place < 0:
            return None
    return place + 1 if count else place


def _is_plain(body: bytes, layout: Layout) -> bool:
    """Whether all lines hold as many cells as the header, and nothing but numbers and missing values."""
    sign = layout.separator.encode()
    rest = body.translate(None, _NUMBER + sign)
    if rest and (rest.translate(None, _MISSING) or _WITH_UNIT.search(body)):
        return False
    begin = 0
    while begin < len(body):
        end = body.rfind(b"\n", begin, begin + _BLOCK) if begin + _BLOCK < len(body) else len(body)
        if end < 0 or not _have_separators(body[begin:end], ord(sign), len(layout.names) - 1):
            return False
        begin = end + 1
    return True


def _have_separators(block: bytes, sign: int, count: int) -> bool:
    """Whether each line of a block has so many separators, and none is empty."""
    signs = np.frombuffer(block, np.uint8)
    separators, ends = np.flatnonzero(signs == sign), np.flatnonzero(signs == ord("\n"))
    counts = np.diff(np.searchsorted(separators, ends), prepend=0, append=len(separators))
    lengths = np.diff(ends, prepend=-1, append=len(block))
    return bool((counts == count).all()) and bool((lengths > 1).all())
