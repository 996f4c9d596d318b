"""Read a file in a separate process first, because its library may crash or hang over a damaged file."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from mkc_torch.recording.formats.base import RecordingError

_PATIENCE = 20.0, 0.5
"""Time limit: seconds, plus seconds per MB of the file."""


def reads_without_crash(path: Path, program: str) -> bool:
    """Whether a separate process that reads a file ends normally, with or without a Python error.

    Args:
        path: path of the file, the program's only argument.
        program: Python source of the program.
    """
    patience = _PATIENCE[0] + _PATIENCE[1] * path.stat().st_size / 1e6
    command = [sys.executable, "-c", program, str(path)]
    try:
        done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, timeout=patience)
    except subprocess.TimeoutExpired:
        return False
    # Python exits with 0 or 1; a crash is a signal, or another exit code on Windows
    return done.returncode in (0, 1)


def broken(path: Path, what: str) -> RecordingError:
    """The error about a file over which its library crashes."""
    return RecordingError(f"{path}: the {what} is damaged; copy it again from where it was written.")
