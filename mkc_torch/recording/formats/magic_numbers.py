"""How files of each kind begin: a file that is of another kind than its ending says is named, not guessed at."""

from __future__ import annotations

from pathlib import Path

from mkc_torch.recording.formats.base import RecordingError

__all__ = ["begins_with", "check_begins", "is_of_another_kind", "wrong_format_error"]

_BEGINS: tuple[tuple[bytes, str, str], ...] = (
    (b"ULog\x01\x12\x35", "a PX4 ULog", ".ulg"),
    (b"\xa3\x95", "an ArduPilot DataFlash log", ".bin"),
    (b"\x89MCAP0\r\n", "an MCAP file", ".mcap"),
    (b"#ROSBAG V", "a ROS 1 bag", ".bag"),
    (b"SQLite format 3\x00", "an SQLite database, as rosbag2 writes", ".db3"),
    (b"\x89HDF\r\n\x1a\n", "an HDF5 file", ".h5"),
    (b"MATLAB", "a MATLAB file", ".mat"),
    (b"MDF     ", "an ASAM MDF file", ".mf4"),
    (b"UnFinMF ", "an ASAM MDF file that was not closed", ".mf4"),
    (b"PAR1", "a Parquet file", ".parquet"),
    (b"PK\x03\x04", "a ZIP archive", ""),
    (b"\x1f\x8b", "a gzip archive", ""),
    (b"\x28\xb5\x2f\xfd", "a file compressed by zstd", ""),
)
"""Magic numbers, from each format's specification: what they say, and the ending that such a file has."""


def begins_with(path: Path, *magic: bytes) -> bool:
    """Whether a file begins with one of these."""
    with path.open("rb") as file:
        begin = file.read(max(map(len, magic)))
    return begin.startswith(magic)


def check_begins(path: Path, what: str, *magic: bytes) -> None:
    """Refuse a file that does not begin with one of these.

    Raises:
        RecordingError: it does not, or it is shorter; the sentence says what it seems to be.
    """
    if not begins_with(path, *magic):
        raise wrong_format_error(path, what)


def is_of_another_kind(data: bytes) -> bool:
    """Whether what should be text begins as one of these, and is no text that only has the same letters.

    Example:
        >>> is_of_another_kind(b"\\x1f\\x8b\\x08\\x00"), is_of_another_kind(b"MATLAB export\\ntime,mag_x")
        (True, False)
    """
    same = data.startswith(tuple(magic for magic, _, _ in _BEGINS))
    return same and any(byte < 9 or byte > 126 for byte in data[:4096])


def wrong_format_error(path: Path, what: str) -> RecordingError:
    """The error about a file that is not of the kind that its ending says."""
    with path.open("rb") as file:
        begin = file.read(16)
    for magic, found, ending in _BEGINS:
        if begin.startswith(magic):
            advice = f"rename it to end in {ending}" if ending else "unpack it first"
            return RecordingError(f"{path}: this is no {what}; it begins as {found} does; {advice}.")
    text = begin.decode("ascii", "replace")
    if text.isprintable() and "\ufffd" not in text:
        found = f'begins as text, "{text}"; if it is a table, rename it to end in .csv'
    else:
        found = f"begins with the bytes {begin[:8].hex(' ')}; copy it anew, or export it as CSV"
    return RecordingError(f"{path}: this is no {what}, or its beginning is damaged; it {found}.")
