"""Read and write Parquet by polars.

polars can crash the process over a damaged file, by requesting too much memory. A file is therefore read in a separate
process first.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mkc_torch.recording.formats.base import FileFormat, RecordingError, Table, Topic, polars
from mkc_torch.recording.formats.damage import quiet_terminal
from mkc_torch.recording.formats.lerobot import is_of_lerobot, joints_and_commands
from mkc_torch.recording.formats.magic_numbers import begins_with, wrong_format_error
from mkc_torch.recording.formats.sandbox import broken, reads_without_crash

_TRIAL = "import io, sys, polars; polars.read_parquet(io.BytesIO(open(sys.argv[1], 'rb').read()))"


def read(path: Path) -> Table:
    """Read the table of a Parquet file."""
    package = polars()
    if not begins_with(path, b"PAR1"):
        raise wrong_format_error(path, "Parquet file")
    if not reads_without_crash(path, _TRIAL):
        raise broken(path, "Parquet file")
    try:
        with quiet_terminal():
            frame = package.read_parquet(io.BytesIO(path.read_bytes()))  # polars would treat a path as a glob pattern
    except package.exceptions.PolarsError as error:
        raise RecordingError(
            f"{path}: this is not a valid Parquet file, or it is damaged: {str(error).splitlines()[0]}"
        ) from error
    except package.exceptions.PanicException as error:  # polars panics over some damaged files
        raise broken(path, "Parquet file") from error
    if not len(frame):
        raise RecordingError(f"{path}: the table has no rows.")
    if is_of_lerobot(frame):
        frame = joints_and_commands(path, frame)
    return Table([name.strip() for name in frame.columns], frame.get_columns(), range(1, len(frame) + 1), "row")


def encoded(_path: Path, columns: Mapping[str, np.ndarray]) -> bytes:
    """Encode columns as the content of a Parquet file."""
    buffer = io.BytesIO()
    polars().DataFrame(dict(columns)).write_parquet(buffer)
    return buffer.getvalue()


PARQUET = FileFormat((".parquet",), lambda path: [Topic("", read(path))], encoded)
