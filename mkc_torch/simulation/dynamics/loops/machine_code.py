"""Compile loops by Numba (BSD-2-Clause; ``pip install mkc-torch[fast]``)."""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any

OFF = "MKC_WITHOUT_NUMBA"
"""Environment variable that disables Numba."""


@cache
def _version() -> int:
    """Checksum of the sources of all loops and of their constants."""
    here = Path(__file__).parent
    return zlib.crc32(b"".join(file.read_bytes() for file in (*sorted(here.glob("*.py")), here.parent / "settings.py")))


@cache
def machine_code(loop: Callable[..., Any]) -> Callable[..., Any] | None:
    """Compile a loop to machine code at its first call, cached on disk; None where Numba is not available.

    A change of any loop, or of the constants that they use, makes a new cache.

    Args:
        loop: a function of NumPy arrays and numbers that Numba can compile.
    """
    if os.environ.get(OFF):
        return None
    try:
        import numba
    except ImportError:
        return None
    loop = FunctionType(loop.__code__, loop.__globals__, loop.__name__)
    # Numba itself only notices changes of the file of this loop, not of the functions that it calls
    loop.__qualname__ = f"{loop.__name__}_{_version():08x}"
    try:
        compiled: Callable[..., Any] = numba.njit(cache=True, error_model="numpy")(loop)
    except RuntimeError:  # no writable folder for the cache
        compiled = numba.njit(error_model="numpy")(loop)
    return compiled
