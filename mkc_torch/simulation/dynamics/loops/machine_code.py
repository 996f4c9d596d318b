"""Machine code of a loop, by Numba (BSD-2-Clause; ``pip install mkc-torch[fast]``)."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache
from typing import Any

__all__ = ["machine_code"]

OFF = "MKC_WITHOUT_NUMBA"
"""Environment variable that leaves Numba out where it is set."""


@cache
def machine_code(loop: Callable[..., Any]) -> Callable[..., Any] | None:
    """A loop compiled to machine code when it is first called, and kept on disk; None where Numba is not installed.

    Args:
        loop: a function of NumPy arrays and numbers in the part of Python that Numba compiles.
    """
    if os.environ.get(OFF):
        return None
    try:
        import numba
    except ImportError:
        return None
    try:
        compiled: Callable[..., Any] = numba.njit(cache=True, error_model="numpy")(loop)
    except RuntimeError:  # there is no folder that machine code could be kept in
        compiled = numba.njit(error_model="numpy")(loop)
    return compiled
