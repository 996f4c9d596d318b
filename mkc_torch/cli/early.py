"""Refuse files that cannot be read before torch is imported, which takes seconds."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import typer

from mkc_torch.cli.console import FAILURES, complain

_SHORT = 2_000_000
"""Largest text file, in bytes, that is read here; it is read again afterwards."""

_AXES = frozenset({"mag_x", "mag_y", "mag_z"})


def refuse_unreadable(path: Path, columns: Mapping[str, str], sensor: str | None, *, magnetometer: bool) -> None:
    """End the command with one line and exit code 1 if a recording cannot be read.

    Args:
        path: the recording.
        columns, sensor: values of ``--columns`` and ``--sensor``.
        magnetometer: whether its magnetometer is read, which must be recognised.

    Raises:
        typer.Exit: the recording cannot be read.
    """
    try:
        _read(path, columns, sensor, magnetometer)
    except FAILURES as error:
        complain(path, error)
        raise typer.Exit(1) from None


def _read(path: Path, columns: Mapping[str, str], sensor: str | None, magnetometer: bool) -> None:
    from mkc_torch.recording.formats import check_file, read_topics
    from mkc_torch.recording.formats.csv import CSV

    check_file(path)
    if path.suffix.lower() not in CSV.endings or path.stat().st_size > _SHORT:
        return
    topics = read_topics(path)
    if not magnetometer or sensor is not None or _AXES & set(columns):
        return
    from mkc_torch.recording.choice import sensors_in, which_columns
    from mkc_torch.recording.formats.base import RecordingError
    from mkc_torch.recording.row_sensors import with_row_sensors

    named = {name for topic in topics for name in topic.table.names}
    if sensors_in(path, with_row_sensors(topics), columns) == [""] and not _AXES & named:
        from mkc_torch.recording.recognise import recognised

        if not recognised(with_row_sensors(topics), path.stem).sensors:
            raise RecordingError(which_columns(path, topics))


def text_of(path: Path) -> str:
    """Return the text of a calibration or a model.

    Raises:
        ValueError: a folder, or not text.
        OSError: the file cannot be read.
    """
    if path.is_dir():
        raise ValueError(f"{path}: this is a folder; give the calibration.json or model.json in it.")
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file.")
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise ValueError(f"{path}: the file is not a text file; give a calibration.json or a model.json.") from None


def refuse_no_text(path: Path) -> None:
    """End the command with one line and exit code 1 if the file of a calibration or model cannot be read.

    Raises:
        typer.Exit: the file cannot be read.
    """
    try:
        text_of(path)
    except FAILURES as error:
        complain(path, error)
        raise typer.Exit(1) from None
