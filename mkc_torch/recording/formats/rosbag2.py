"""Bags of ROS 2: a folder with ``metadata.yaml``, or its ``.db3`` alone.

The database is read by the sqlite3 of Python: rosbags reads no bag whose ``metadata.yaml`` is missing, as after a loss
of power, and nothing of a database that is damaged.

Source: github.com/ros2/rosbag2, rosbag2_storage_sqlite3 and docs/message_definition_encoding.md.
"""

from __future__ import annotations

import contextlib
import sqlite3
from pathlib import Path
from typing import Any
from urllib.parse import quote

from mkc_torch.recording.formats.base import FileFormat, RecordingError, Topic, listed
from mkc_torch.recording.formats.compression import inflated
from mkc_torch.recording.formats.damage import guarded, no_rows, with_warnings
from mkc_torch.recording.formats.magic_numbers import begins_with, check_begins
from mkc_torch.recording.formats.mcap import gather_mcap
from mkc_torch.recording.formats.message_log import MessageLog
from mkc_torch.recording.formats.message_rows import LARGEST_MESSAGE
from mkc_torch.recording.formats.ros_messages import RosReader, known_definitions, parsed_definitions, type_name

__all__ = ["ROSBAG2"]

_MAGIC = b"SQLite format 3\0"
_ZSTD = b"\x28\xb5\x2f\xfd"
_METADATA = "metadata.yaml"


def read(path: Path) -> list[Topic]:
    """The topics of a bag, all of its files together: nested fields with dots, arrays ``[i]``, times in ns.

    ``header.stamp`` is the sensor's own time, ``log_time`` when the message was written down. Message types that the
    bag does not define are those of ROS 2's own packages. The database is opened for reading only; memory is eight
    bytes a number, and messages of more than 64 KiB, such as pictures, are passed over.

    Raises:
        RecordingError: no such bag, one compressed as a whole, or one without a message that is understood.
        ImportError: rosbags, or mcap for a bag that holds such files, is not installed.
    """
    try:
        import rosbags.typesys  # noqa: F401
    except ImportError as error:
        raise ImportError(
            'ROS bags are read with rosbags; install it with `pip install "mkc-torch[rosbag]"`.'
        ) from error
    log = MessageLog()
    warnings: list[str] = []
    files = _files(path, warnings) if path.is_dir() else [path]
    for file in files:
        if file.suffix.lower() == ".mcap":
            warnings += gather_mcap(file, log)
        else:
            warnings += _gather_database(file, log)
    topics, told = log.topics()
    if not topics:
        raise no_rows(path, "ROS 2 bag", [*warnings, *told])
    return with_warnings(topics, [*warnings, *told])


def _files(folder: Path, warnings: list[str]) -> list[Path]:
    """The files of a bag that metadata.yaml names, or those that lie there if it is damaged."""
    there = sorted(path for path in folder.iterdir() if path.suffix.lower() in (".db3", ".mcap"))
    named = _named(folder / _METADATA)
    files = [folder / name for name in named]
    missing = [path.name for path in files if not path.is_file()]
    if any(name.endswith(".zstd") for name in named):
        raise RecordingError(f"{folder}: the bag is compressed file by file; unpack it: `unzstd {folder}/*.zstd`.")
    if not named:
        warnings.append(f"{_METADATA} is damaged or names no file; all files beside it are read.")
    if missing:
        warnings.append(f"{_METADATA} names {listed(missing)}, but there is no such file.")
    found = [path for path in files if path.is_file()] or there
    if not found:
        raise RecordingError(f"{folder}: the bag has no file of messages (.db3 or .mcap); copy the whole folder.")
    return found


def _named(metadata: Path) -> list[str]:
    """The names of the bag's files; none where they are not to be read."""
    from ruamel.yaml import YAML

    try:
        found: Any = YAML(typ="safe", pure=True).load(metadata.read_text(encoding="utf-8"))
        paths = found["rosbag2_bagfile_information"]["relative_file_paths"]
        return [Path(str(name)).name for name in paths]
    except Exception:  # a damaged text leads the parser to errors of many kinds; the files speak for themselves
        return []


def _gather_database(path: Path, log: MessageLog) -> list[str]:
    """Add the messages of a database to a log, and say what of it is lost."""
    if path.stat().st_size == 0:
        raise RecordingError(f"{path}: the file is empty; record it anew, or copy it whole.")
    if begins_with(path, _ZSTD):
        raise RecordingError(f"{path}: the file is compressed; unpack it: `unzstd {path}`.")
    check_begins(path, "database of a ROS 2 bag", _MAGIC)
    warnings = []
    beside = [f"{path.name}{end}" for end in ("-wal", "-journal") if path.with_name(path.name + end).exists()]
    if beside:
        warnings.append(
            f"Beside the bag lies {listed(beside)}, rows not yet written into it; open the bag once with `sqlite3`."
        )
    # immutable: neither a lock nor a journal is made beside the user's file
    address = f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1"
    with guarded(path, "ROS 2 bag"), contextlib.closing(sqlite3.connect(address, uri=True)) as base:
        base.execute("PRAGMA trusted_schema = OFF")
        base.execute("PRAGMA cell_size_check = ON")
        # a view can stand for rows without end
        tables = {name for (name,) in base.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"topics", "messages"} <= tables:
            raise RecordingError(f"{path}: the database holds no ROS 2 bag (the tables `topics` and `messages`).")
        _open_topics(path, base, log)
        warnings += _add_messages(path, base, log)
    return warnings


def _open_topics(path: Path, base: sqlite3.Connection, log: MessageLog) -> None:
    definitions = _definitions(base)
    for number, name, kind, encoding in base.execute("SELECT id, name, type, serialization_format FROM topics"):
        text, form = definitions.get(str(kind), ("", ""))
        try:
            if encoding != "cdr":
                raise ValueError(f"encoded as {encoding}, not cdr")
            own = parsed_definitions(text, type_name(str(kind)), idl=form == "ros2idl") if text else {}
            reader = RosReader(str(kind), {**known_definitions(), **own})
        except Exception as error:  # what the parser raises over a damaged definition
            lines = str(error).strip().splitlines() or [type(error).__name__]
            log.leave_out(str(name), f"its messages, of {kind}, are not understood ({lines[0][:100]})")
        else:
            log.open((path, number), str(name), str(kind), reader.read, reader.units)


def _definitions(base: sqlite3.Connection) -> dict[str, tuple[str, str]]:
    """By type, its definition and how that is written; bags from before 2023 have none."""
    try:
        rows = base.execute("SELECT topic_type, encoded_message_definition, encoding FROM message_definitions")
        return {str(kind): (str(text or ""), str(form)) for kind, text, form in rows}
    except sqlite3.OperationalError:
        return {}


def _add_messages(path: Path, base: sqlite3.Connection, log: MessageLog) -> list[str]:
    try:
        for number, time, data in base.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY id"):
            if isinstance(data, bytes) and isinstance(time, int):
                plain = inflated("zstd", data, LARGEST_MESSAGE + 1) if data.startswith(_ZSTD) else data
                log.add((path, number), plain, time)
    except sqlite3.DatabaseError as error:
        return [f"The database is damaged or cut off ({error}); its messages up to there are read."]
    return []


ROSBAG2 = FileFormat((".db3",), read, marker=_METADATA)
