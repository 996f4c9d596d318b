"""Decompress the blocks of logs; a block that is cut off is decompressed as far as possible."""

from __future__ import annotations

import bz2
import io
from collections.abc import Callable
from typing import Any

_PIECE = 2**20
"""Bytes decompressed at once."""

_LARGEST_BLOCK = 2**30
"""Largest decompressed block in bytes; loggers write blocks of a few MB, larger blocks are damaged or malicious."""


def inflated(kind: str, data: bytes, size: int) -> bytes:
    """Decompress a block as far as it can be read.

    Args:
        kind: compression: "" or "none", "bz2", "lz4" (a frame) or "zstd".
        data: the compressed bytes.
        size: size of the content in bytes according to the file, an upper bound of the result.

    Raises:
        ValueError: an unknown compression.
        ImportError: the library for the compression is not installed.
    """
    if kind in ("", "none"):
        return data
    if kind not in _OPENED:
        raise ValueError(f"it is compressed by {kind[:20]!r}, which cannot be read: write it again without compression")
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
    except Exception:  # each library raises its own errors for truncated data; the parts before are kept
        return b"".join(parts)
    return b"".join(parts)


def _zstd(data: bytes) -> Any:
    import zstandard

    return zstandard.ZstdDecompressor().stream_reader(io.BytesIO(data), read_across_frames=False)


class _Pieces:
    """A stream over a decompressor that takes all its input at once."""

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
