"""Compressed blocks of logs: of one that is cut off, what its beginning still says."""

from __future__ import annotations

import bz2
import io
from collections.abc import Callable
from typing import Any

__all__ = ["inflated"]

_PIECE = 2**20
_LARGEST_BLOCK = 2**30
"""Bytes; loggers write blocks of one to a few MB. A block that unpacks to more is damage, or meant to do harm."""


def inflated(kind: str, data: bytes, size: int) -> bytes:
    """The content of a block, up to where it can be read.

    Args:
        kind: "" or "none", "bz2", "lz4" (a frame) or "zstd".
        size: of the content in bytes, as the file says; no more is unpacked.

    Raises:
        ValueError: a kind that is not known.
        ImportError: the library for it is not installed.
    """
    if kind in ("", "none"):
        return data
    if kind not in _OPENED:
        raise ValueError(f"it is compressed by {kind[:20]!r}, which is not read: write it anew without compression")
    if size > _LARGEST_BLOCK:
        return b""
    parts: list[bytes] = []
    left = size
    try:
        stream = _OPENED[kind](data)
        while left > 0 and (part := stream.read(min(left, _PIECE))):
            parts.append(part)
            left -= len(part)
    except ImportError:
        raise
    except Exception:  # each library has errors of its own for data that are cut off: what came before them stays
        return b"".join(parts)
    return b"".join(parts)


def _zstd(data: bytes) -> Any:
    import zstandard

    return zstandard.ZstdDecompressor().stream_reader(io.BytesIO(data), read_across_frames=False)


class _Pieces:
    """Reads from a decompressor that takes all its input at once."""

    def __init__(self, decompressor: Any, data: bytes) -> None:
        self._decompressor, self._data = decompressor, data

    def read(self, count: int) -> bytes:
        if self._decompressor.eof:
            return b""
        data, self._data = self._data, b""
        return self._decompressor.decompress(data, max_length=count)


def _lz4(data: bytes) -> Any:
    import lz4.frame

    return _Pieces(lz4.frame.LZ4FrameDecompressor(), data)


_OPENED: dict[str, Callable[[bytes], Any]] = {
    "bz2": lambda data: _Pieces(bz2.BZ2Decompressor(), data),
    "lz4": _lz4,
    "zstd": _zstd,
}
