"""A text file as numbered lines: its encoding, and what a power-off leaves at its end."""

from __future__ import annotations

import codecs
import io
from pathlib import Path
from typing import NamedTuple

from mkc_torch.recording.formats.base import RecordingError, counted
from mkc_torch.recording.formats.magic_numbers import is_of_another_kind, wrong_format_error

__all__ = ["Line", "lines_of"]

_SAMPLE = 4096
_UTF_16 = 0.4
"""Share of zero bytes at the even, or at the odd, places from which text without a mark is UTF-16: ASCII has 1."""

_FEW_CUTS = 3

_PLAIN = {"\t", "\n", "\r", "\f", "\0", "\x1a"}


class Line(NamedTuple):
    """A line that is not blank, its number in the file, from 1, and whether zero bytes took its end."""

    number: int
    text: str
    cut: bool = False


def lines_of(path: Path) -> tuple[list[Line], list[str]]:
    """The lines of a file that are not blank, and sentences about what had to be done to read them.

    UTF-8, UTF-16 (by its mark, or by its zero bytes), and Latin-1 where everything outside ASCII is printable there,
    such as µ and °. Zero bytes, which a file system leaves where power went off, are skipped.

    Raises:
        RecordingError: the file is no text, or holds none.
    """
    data = path.read_bytes()
    if is_of_another_kind(data):
        raise wrong_format_error(path, "text")
    text, warnings = _decoded(path, data)
    if "\u2212" in text:
        text = text.replace("\u2212", "-")
        warnings.append("Typographic minus signs were read as minus signs.")
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
    if sum(line.cut for line in lines) > max(_FEW_CUTS, len(lines) // 100):  # a program's way of ending lines
        lines = [line._replace(cut=False) for line in lines]
    if zeros:
        warnings.append(
            f"Zero bytes, as a power-off leaves them, are skipped in {counted(len(zeros), 'line')}, the first "
            f"{zeros[0]}."
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
        # what is cut within a letter at the end is left out
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
            f"{path}: the file begins as UTF-16 does, but is no such text from byte {error.start} on; export it as CSV "
            "in UTF-8."
        ) from None
    _refuse_binary(path, text)
    return text, []


def _without_mark(head: bytes) -> str | None:
    """UTF-16 by every other byte being zero."""
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
        if text and all(one.isprintable() or one in _PLAIN for one in text):
            return text, [f"The file is not UTF-8 and was read as Windows-1252, first in line {line}."]
        raise RecordingError(
            f"{path}: the file is not UTF-8 text: line {line} holds the byte 0x{data[start]:02x}; export it as CSV in "
            "UTF-8."
        )
    text = data.decode("latin-1")
    _refuse_binary(path, text)
    shown = " ".join(chr(byte) for byte in strange[:8])
    return text, [f"The file is not UTF-8 and was read as Latin-1: {shown}, first in line {line}."]


def _refuse_binary(path: Path, text: str) -> None:
    head = text[:_SAMPLE]
    strange = [one for one in head if (one < " " and one not in _PLAIN) or one == "\ufffe"]
    if len(strange) > 0.02 * len(head):
        raise RecordingError(f"{path}: the file is not text but binary data; export it as CSV in UTF-8.")
