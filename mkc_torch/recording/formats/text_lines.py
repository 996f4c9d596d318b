"""Read a text file as numbered lines: detect its encoding, and skip the zero bytes of a power loss."""

from __future__ import annotations

import codecs
import io
from pathlib import Path
from typing import NamedTuple

from mkc_torch._support.note import Note
from mkc_torch.recording.formats.base import RecordingError, counted
from mkc_torch.recording.formats.magic_numbers import is_of_another_kind, wrong_format_error

_SAMPLE = 4096
"""Bytes or characters at the beginning that are examined."""

_UTF_16 = 0.4
"""Smallest share of zero bytes, at even or at odd offsets, in UTF-16 without a byte order mark; 1 for ASCII text."""

_FEW_CUTS = 3
"""Most lines that a power loss cuts; a file with more has zero bytes as line ends, written by a program."""

_PLAIN = {"\t", "\n", "\r", "\f", "\0", "\x1a"}


class Line(NamedTuple):
    """A line that is not blank.

    Attributes:
        number: line number in the file, from 1.
        text: the line.
        cut: True if zero bytes replaced its end.
    """

    number: int
    text: str
    cut: bool = False


def lines_of(path: Path) -> tuple[list[Line], list[str]]:
    """Read the lines of a file that are not blank, and warnings about its encoding.

    Encodings: UTF-8, UTF-16 (by its byte order mark or its zero bytes), Windows-1252, and Latin-1 if all characters
    outside ASCII are printable, such as µ and °. Zero bytes, which a file system leaves after a power loss, are
    skipped.

    Raises:
        RecordingError: the file is not text, or is empty.
    """
    data = path.read_bytes()
    if is_of_another_kind(data):
        raise wrong_format_error(path, "text file")
    text, warnings = _decoded(path, data)
    if "\u2212" in text:
        text = text.replace("\u2212", "-")
        warnings.append(Note("Typographic minus signs were read as minus signs."))
    lines: list[Line] = []
    zeros: list[int] = []
    for number, line in enumerate(io.StringIO(text, newline=None), start=1):
        line = line.rstrip("\n")
        if "\0" in line or "\x1a" in line:
            zeros.append(number)
            parts = line.replace("\x1a", "\0").split("\0")
            ends = [place < len(parts) - 1 and bool("".join(parts[:-1])) for place in range(len(parts))]
            lines += [Line(number, part, cut) for part, cut in zip(parts, ends, strict=True) if part.strip()]
        elif line.strip():
            lines.append(Line(number, line))
    if sum(line.cut for line in lines) > max(_FEW_CUTS, len(lines) // 100):  # the line ends of a program
        lines = [line._replace(cut=False) for line in lines]
    if zeros:
        warnings.append(
            f"Zero bytes, as left by a power loss, are skipped in {counted(len(zeros), 'line')}, the first {zeros[0]}."
        )
    if not lines:
        raise RecordingError(f"{path}: the file is empty; it must hold a header line and rows of numbers.")
    return lines, warnings


def _decoded(path: Path, data: bytes) -> tuple[str, list[str]]:
    for mark, name in ((codecs.BOM_UTF16_LE, "utf-16-le"), (codecs.BOM_UTF16_BE, "utf-16-be")):
        if data.startswith(mark):
            return _utf_16(path, data[len(mark) :], name)
    if unmarked := _without_mark(data[:_SAMPLE]):
        return _utf_16(path, data, unmarked)
    try:
        # final=False drops an incomplete character at the end
        text = codecs.getincrementaldecoder("utf-8-sig")().decode(data, final=False)
    except UnicodeDecodeError as error:
        return _latin_1(path, data, error.start)
    _refuse_binary(path, text)
    return text, []


def _utf_16(path: Path, data: bytes, name: str) -> tuple[str, list[str]]:
    try:
        text = codecs.getincrementaldecoder(name)().decode(data, final=False)
    except UnicodeDecodeError as error:
        raise RecordingError(
            f"{path}: the file begins as UTF-16 but is not valid from byte {error.start} on; export it as CSV in UTF-8."
        ) from None
    _refuse_binary(path, text)
    return text, []


def _without_mark(head: bytes) -> str | None:
    """The UTF-16 encoding of text without a byte order mark, by its zero bytes; None for other text."""
    half = len(head) // 2
    if half < 4 or head.strip(b"\0") == b"":
        return None
    even, odd = head[0 : 2 * half : 2].count(0) / half, head[1 : 2 * half : 2].count(0) / half
    if even < 0.05 and odd > _UTF_16:
        return "utf-16-le"
    return "utf-16-be" if odd < 0.05 and even > _UTF_16 else None


def _latin_1(path: Path, data: bytes, start: int) -> tuple[str, list[str]]:
    line = 1 + data[:start].count(b"\n")
    strange = sorted({byte for byte in data if byte >= 0x80})
    if any(byte < 0xA0 for byte in strange):
        try:
            text = data.decode("cp1252")
        except UnicodeDecodeError:
            text = ""
        if text and all(letter.isprintable() or letter in _PLAIN for letter in text):
            return text, [Note(f"The file is not UTF-8 and was read as Windows-1252, first in line {line}.")]
        raise RecordingError(
            f"{path}: the file is not UTF-8 text: line {line} holds the byte 0x{data[start]:02x}; export it as CSV in "
            "UTF-8."
        )
    text = data.decode("latin-1")
    _refuse_binary(path, text)
    shown = " ".join(chr(byte) for byte in strange[:8])
    return text, [Note(f"The file is not UTF-8 and was read as Latin-1: {shown}, first in line {line}.")]


def _refuse_binary(path: Path, text: str) -> None:
    head = text[:_SAMPLE]
    strange = [letter for letter in head if (letter < " " and letter not in _PLAIN) or letter == "\ufffe"]
    if len(strange) > 0.02 * len(head):
        raise RecordingError(f"{path}: the file is not text but binary data; export it as CSV in UTF-8.")
