"""A file read in a process of its own first, where the library that reads it may end or never end over damaged ones."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from mkc_torch.recording.formats.base import RecordingError

__all__ = ["broken", "reads_without_crash"]

_PATIENCE = 20.0, 0.5
"""Seconds, and seconds for each MB of the file."""


def reads_without_crash(path: Path, program: str) -> bool:
    """Whether a process that reads a file comes to its end, with an error or without.

    Args:
        path: of the file, the program's one argument.
        program: in Python.
    """
    patience = _PATIENCE[0] + _PATIENCE[1] * path.stat().st_size / 1e6
    command = [sys.executable, "-c", program, str(path)]
    try:
        done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, timeout=patience)
    except subprocess.TimeoutExpired:
        return False
    # Python itself ends with 0 or 1; what a library ends by is a signal here, and another code on Windows
    return done.returncode in (0, 1)


def broken(path: Path, what: str) -> RecordingError:
    """The error over a file that its library does not survive."""
    return RecordingError(f"{path}: the {what} is damaged; copy it anew from where it was written.")
