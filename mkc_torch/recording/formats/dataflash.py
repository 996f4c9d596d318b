"""Read ArduPilot's DataFlash logs, binary (``.bin``) and text (``.log``)."""

from __future__ import annotations

from pathlib import Path

from mkc_torch.recording.formats.base import FileFormat, RecordingError, Topic
from mkc_torch.recording.formats.damage import guarded, no_rows, with_warnings
from mkc_torch.recording.formats.dataflash_binary import read_binary
from mkc_torch.recording.formats.dataflash_text import read_text
from mkc_torch.recording.formats.magic_numbers import begins_with, wrong_format_error

_WHAT = "ArduPilot DataFlash log"
_HEAD = 4096
"""Bytes at the beginning of a text log that are searched for a message definition."""


def read(path: Path) -> list[Topic]:
    """Read the topics of a log, ``MAG`` or ``MAG[0]``, ``MAG[1]``, with ArduPilot's names of messages and columns.

    ``TimeUS`` is in µs; ``TimeMS`` of logs from before 2015 is in ms. Units are those that the log states (UNIT, MULT,
    FMTU), or else those that ArduPilot never changed: ``MAG`` in mGauss, ``IMU`` in rad/s and m/s².

    Raises:
        RecordingError: the file is not a DataFlash log, or has no complete message.
    """
    if begins_with(path, b"\xa3\x95"):
        reader = read_binary
    elif _is_text(path):
        reader = read_text
    else:
        raise _not_a_log(path)
    with guarded(path, _WHAT):
        topics, warnings = reader(path)
    if not topics:
        raise no_rows(path, _WHAT, warnings)
    return with_warnings(topics, warnings)


def _is_text(path: Path) -> bool:
    """Whether a line near the beginning defines a message; a header of the ground station may precede it."""
    with path.open("rb") as file:
        head = file.read(_HEAD)
    return b"\0" not in head and any(line.lstrip().startswith(b"FMT,") for line in head.splitlines())


def _not_a_log(path: Path) -> RecordingError:
    if path.suffix.lower() == ".log":
        return RecordingError(
            f"{path}: this is not an {_WHAT}: no line near its beginning defines a message (FMT, …); "
            "if it is a table, rename it to end in .csv."
        )
    return wrong_format_error(path, _WHAT)


DATAFLASH = FileFormat((".bin", ".log"), read)
