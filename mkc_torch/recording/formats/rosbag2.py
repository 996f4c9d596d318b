"""Read ROS 2 bags: a folder with ``metadata.yaml``, or a single ``.db3`` file.

The database is read by Python's sqlite3: rosbags cannot read a bag without ``metadata.yaml``, as after a loss of power,
or a damaged database.

Source: github.com/ros2/rosbag2, rosbag2_storage_sqlite3 and docs/message_definition_encoding.md.
"""

from __future__ import annotations

import contextlib
import sqlite3
from pathlib import Path
from typing import Any
from urllib.parse import quote

from mkc_torch.recording.formats.base import FileFormat, RecordingError, Topic, listed, optional
from mkc_torch.recording.formats.compression import inflated
from mkc_torch.recording.formats.damage import guarded, no_rows, with_warnings
from mkc_torch.recording.formats.magic_numbers import begins_with, check_begins
from mkc_torch.recording.formats.mcap import gather_mcap
from mkc_torch.recording.formats.message_log import MessageLog
from mkc_torch.recording.formats.message_rows import LARGEST_MESSAGE
from mkc_torch.recording.formats.ros_messages import RosReader, known_definitions, parsed_definitions, type_name

_MAGIC = b"SQLite format 3\0"
_ZSTD = b"\x28\xb5\x2f\xfd"
_METADATA = "metadata.yaml"


def read(path: Path) -> list[Topic]:
    """Read the topics of a bag, from all of its files: nested fields with dots, arrays ``[i]``, times in ns.

    ``header.stamp`` is the sensor's own time; ``log_time`` is when the message was logged. Message types that the bag
    does not define are taken from ROS 2's own packages. The database is opened read-only. Memory is eight bytes per
    number; messages larger than 64 KiB, such as images, are skipped.

    Raises:
        RecordingError: not a ROS 2 bag, a bag compressed as a whole, or a bag without a readable message.
        ImportError: rosbags is not installed, or mcap for a bag of MCAP files.
    """
    optional("rosbags.typesys", "ROS bags", "rosbag")
    log = MessageLog()
    warnings: list[str] = []
    files = _files(path, warnings) if path.is_dir() else [path]
    for file in files:
        if file.suffix.lower() == ".mcap":
            warnings += gather_mcap(file, log)
        else:
            warnings += _gather_database(file, log)
    topics, left_out = log.topics()
    if not topics:
        raise no_rows(path, "ROS 2 bag", [*warnings, *left_out])
    return with_warnings(topics, [*warnings, *left_out])


def _files(folder: Path, warnings: list[str]) -> list[Path]:
    """The files of a bag that metadata.yaml names, or all files of its folder if metadata.yaml is damaged."""
    there = sorted(path for path in folder.iterdir() if path.suffix.lower() in (".db3", ".mcap"))
    named = _named(folder / _METADATA)
    files = [folder / name for name in named]
    missing = [path.name for path in files if not path.is_file()]
    if any(name.endswith(".zstd") for name in named):
        raise RecordingError(f"{folder}: the bag is compressed file by file; unpack it: `unzstd {folder}/*.zstd`.")
    if not named:
        warnings.append(f"{_METADATA} is damaged or names no file; all files in its folder are read.")
    if missing:
        warnings.append(f"{_METADATA} names {listed(missing)}, but there is no such file.")
    found = [path for path in files if path.is_file()] or there
    if not found:
        raise RecordingError(f"{folder}: the bag has no file of messages (.db3 or .mcap); copy the whole folder.")
    return found


def _named(metadata: Path) -> list[str]:
    """The names of the bag's files; empty if metadata.yaml cannot be read."""
    from ruamel.yaml import YAML

    try:
        found: Any = YAML(typ="safe", pure=True).load(metadata.read_text(encoding="utf-8"))
        paths = found["rosbag2_bagfile_information"]["relative_file_paths"]
        return [Path(str(name)).name for name in paths]
    except Exception:  # the parser raises arbitrary errors over a damaged text; the files of the folder are used
        return []


def _gather_database(path: Path, log: MessageLog) -> list[str]:
    """Add the messages of a database to a log; returns warnings about lost parts."""
    if path.stat().st_size == 0:
        raise RecordingError(f"{path}: the file is empty; record it again, or copy the whole file.")
    if begins_with(path, _ZSTD):
        raise RecordingError(f"{path}: the file is compressed; unpack it: `unzstd {path}`.")
    check_begins(path, "database of a ROS 2 bag", _MAGIC)
    warnings = []
    pending = [f"{path.name}{end}" for end in ("-wal", "-journal") if path.with_name(path.name + end).exists()]
    if pending:
        warnings.append(
            f"{listed(pending)} holds rows that are not yet written into the bag; open the bag once with `sqlite3`."
        )
    # immutable: sqlite creates no lock or journal in the user's folder
    address = f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1"
    with guarded(path, "ROS 2 bag"), contextlib.closing(sqlite3.connect(address, uri=True)) as base:
        base.execute("PRAGMA trusted_schema = OFF")
        base.execute("PRAGMA cell_size_check = ON")
        # only tables: a view can generate rows without end
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
        except Exception as error:  # the parser raises arbitrary errors over a damaged definition
            lines = str(error).strip().splitlines() or [type(error).__name__]
            log.leave_out(str(name), f"its messages, of {kind}, cannot be read ({lines[0][:100]})")
        else:
            log.open((path, number), str(name), str(kind), reader.read, reader.units)


def _definitions(base: sqlite3.Connection) -> dict[str, tuple[str, str]]:
    """Message type to its definition and the encoding of that; bags from before 2023 have no definitions."""
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
        return [f"The database is damaged or cut off ({error}); its messages before the damage are read."]
    return []


ROSBAG2 = FileFormat((".db3",), read, marker=_METADATA)
