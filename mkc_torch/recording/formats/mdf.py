"""Read ASAM MDF files (``.mf4``, ``.mdf``), versions 2 to 4, by asammdf in a separate process.

asammdf is large: it brings pandas and canmatrix, and takes two seconds to import. No other library is as complete:
mdfreader is no longer maintained.

Source: ASAM MDF 4.2.
"""

from __future__ import annotations

import atexit
import contextlib
import importlib.util
import json
import math
import os
import struct
import subprocess
import sys
import threading
from pathlib import Path
from typing import IO, Any

import numpy as np

from mkc_torch._support.note import Note
from mkc_torch.recording.formats.base import FileFormat, RecordingError, Topic
from mkc_torch.recording.formats.damage import no_rows, with_warnings
from mkc_torch.recording.formats.magic_numbers import begins_with, check_begins
from mkc_torch.recording.formats.topics import MOST_ELEMENTS, spread, topic_of

_WHAT = "ASAM MDF file"
_BEGINS = b"MDF     ", b"UnFinMF "
_SCRIPT = Path(__file__).with_name("mdf_process.py")
_PATIENCE = 60.0, 2.0
"""Time limit: seconds, plus seconds per MB of the file; asammdf can loop forever over a damaged file."""


def read(path: Path) -> list[Topic]:
    """Read the topics of a file: each channel group is a topic, named by its acquisition, its source, or ``group_0``.

    Values are physical, by the conversions of the file; labelled values stay numbers. Units are those of the channels.
    The master channel, usually ``time`` in s, comes first. Values that the file marks as invalid are NaN. Memory is
    that of all channels, twice for a moment.

    A channel whose conversion is a text formula is left out, because the formula would be executed.

    Raises:
        RecordingError: the file is not an MDF file, is damaged, or has no rows.
        ImportError: asammdf is not installed.
    """
    check_begins(path, _WHAT, *_BEGINS)
    if importlib.util.find_spec("asammdf") is None:
        raise ImportError('MDF files are read with asammdf; install it with `pip install "mkc-torch[mdf]"`.')
    found, warnings = _READER.groups(path)
    if begins_with(path, _BEGINS[1]):
        warnings.append("The file was not closed by its recorder; its last rows may be missing.")
    topics = [topic for group in found if (topic := _topic(group)) is not None]
    if not topics:
        raise no_rows(path, _WHAT, warnings)
    return with_warnings(topics, warnings)


def _topic(group: dict[str, Any]) -> Topic | None:
    columns: dict[str, np.ndarray] = {}
    units: dict[str, str] = {}
    warnings = list(group["warnings"])
    for name, values in group["columns"].items():
        if math.prod(values.shape[1:]) > MOST_ELEMENTS:
            warnings.append(Note(f"`{name}`: more than {MOST_ELEMENTS} numbers per row, left out."))
            continue
        parts = spread(name, values)
        columns |= parts
        units |= dict.fromkeys(parts, group["units"].get(name, ""))
    rows = {len(values) for values in columns.values()}
    return topic_of(group["name"], columns, units, warnings) if len(rows) == 1 and rows != {0} else None


class _Reader:
    """The reader process: started for the first file, restarted after a crash, ended with this process."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._owner = os.getpid()
        self._lock = threading.Lock()

    def groups(self, path: Path) -> tuple[list[dict[str, Any]], list[str]]:
        """Read the groups of a file, and warnings about it.

        Raises:
            RecordingError: the file is damaged.
        """
        with self._lock:
            process = self._process
            if process is None or self._owner != os.getpid() or process.poll() is not None:
                process = self._started()
            patience = _PATIENCE[0] + _PATIENCE[1] * path.stat().st_size / 1e6
            timer = threading.Timer(patience, process.kill)
            timer.start()
            try:
                assert process.stdin is not None
                assert process.stdout is not None
                process.stdin.write(json.dumps(str(path.resolve())).encode() + b"\n")
                process.stdin.flush()
                header, found = _received(process.stdout)
            except (EOFError, OSError) as error:
                self.end()
                raise _damaged(path, "the library that reads it crashed") from error
            finally:
                timer.cancel()
        if "error" in header:
            raise _damaged(path, header["error"])
        return found, header["warnings"]

    def _started(self) -> subprocess.Popen[bytes]:
        self.end()
        # use this process's sys.path, not the script's folder, whose csv.py would shadow Python's
        start = "import json, runpy, sys; sys.path[:] = json.loads(sys.argv[1]); "
        start += "runpy.run_path(sys.argv[2], run_name='__main__')"
        self._owner = os.getpid()
        self._process = subprocess.Popen(
            [sys.executable, "-c", start, json.dumps(sys.path), str(_SCRIPT)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        return self._process

    def end(self) -> None:
        """End the reader process if this process started it; after a fork it belongs to the parent."""
        if self._process is None or self._owner != os.getpid():
            return
        self._process.kill()
        for pipe in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(OSError):
                if pipe is not None:
                    pipe.close()
        self._process.wait()
        self._process = None


def _received(pipe: IO[bytes]) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Receive the header and the groups of a reply."""
    (length,) = struct.unpack("<Q", _exactly(pipe, 8))
    header = json.loads(_exactly(pipe, length))
    groups = header.get("groups", [])
    for group in groups:
        columns = {}
        for name, kind, shape in group["columns"]:
            layout = np.dtype(kind)
            block = _exactly(pipe, layout.itemsize * math.prod(shape))
            columns[name] = np.frombuffer(block, layout).reshape(shape)
        group["columns"] = columns
    return header, groups


def _exactly(pipe: IO[bytes], count: int) -> bytes:
    data = pipe.read(count) if count else b""
    if len(data) < count:
        raise EOFError("The process has ended.")
    return data


def _damaged(path: Path, reason: str) -> RecordingError:
    return RecordingError(
        f"{path}: the {_WHAT} cannot be read: it is damaged ({reason}); copy it again from where it was recorded."
    )


_READER = _Reader()
atexit.register(_READER.end)

MDF = FileFormat((".mf4", ".mdf"), read)
