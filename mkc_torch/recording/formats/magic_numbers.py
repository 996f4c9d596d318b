"""Magic numbers of file formats, to report a file whose format differs from its ending."""

from __future__ import annotations

from pathlib import Path

from mkc_torch.recording.formats.base import RecordingError

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
"""Magic number from each format's specification, name of the format with its article, and ending of its files."""


def begins_with(path: Path, *magic: bytes) -> bool:
    """Whether a file begins with any of the given magic numbers."""
    with path.open("rb") as file:
        begin = file.read(max(map(len, magic)))
    return begin.startswith(magic)


def check_begins(path: Path, what: str, *magic: bytes) -> None:
    """Check that a file begins with any of the given magic numbers.

    Raises:
        RecordingError: it does not, or it is shorter; the message names the format that it seems to have.
    """
    if not begins_with(path, *magic):
        raise wrong_format_error(path, what)


def is_of_another_kind(data: bytes) -> bool:
    """Whether data begins with a known magic number and is binary, not text with the same letters.

    Example:
        >>> is_of_another_kind(b"\\x1f\\x8b\\x08\\x00"), is_of_another_kind(b"MATLAB export\\ntime,mag_x")
        (True, False)
    """
    same = data.startswith(tuple(magic for magic, _, _ in _BEGINS))
    return same and any(byte < 9 or byte > 126 for byte in data[:4096])


def wrong_format_error(path: Path, what: str) -> RecordingError:
    """The error about a file that does not have the format of its ending."""
    with path.open("rb") as file:
        begin = file.read(16)
    for magic, found, ending in _BEGINS:
        if begin.startswith(magic):
            advice = f"rename it to end in {ending}" if ending else "unpack it first"
            return RecordingError(f"{path}: this is not a valid {what}; it begins like {found}; {advice}.")
    text = begin.decode("ascii", "replace")
    if text.isprintable() and "\ufffd" not in text:
        found = f'begins with the text "{text}"; if it is a table, rename it to end in .csv'
    else:
        found = f"begins with the bytes {begin[:8].hex(' ')}; copy it again, or export it as CSV"
    return RecordingError(f"{path}: this is not a valid {what}, or its beginning is damaged; it {found}.")
