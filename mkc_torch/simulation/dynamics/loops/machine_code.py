"""Compile loops by Numba (BSD-2-Clause; ``pip install mkc-torch[fast]``)."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache
from typing import Any

__all__ = ["machine_code"]

OFF = "MKC_WITHOUT_NUMBA"
"""Environment variable that disables Numba."""


@cache
def machine_code(loop: Callable[..., Any]) -> Callable[..., Any] | None:
    """Compile a loop to machine code at its first call, cached on disk; None where Numba is not available.

    Args:
        loop: a function of NumPy arrays and numbers that Numba can compile.
    """
    if os.environ.get(OFF):
        return None
    try:
        import numba
    except ImportError:
        return None
    try:
        compiled: Callable[..., Any] = numba.njit(cache=True, error_model="numpy")(loop)
    except RuntimeError:  # no writable folder for the cache
        compiled = numba.njit(error_model="numpy")(loop)
    return compiled
