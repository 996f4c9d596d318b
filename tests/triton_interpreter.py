"""Skip tests of kernels where Triton's interpreter cannot run."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest

__all__ = ["skip_without_interpreter"]


def skip_without_interpreter() -> None:
    """Skip if Triton is absent, or if its interpreter fails with the installed NumPy."""
    triton = pytest.importorskip("triton")
    if _release(triton) < (3, 3) and _release(np) >= (2, 4):
        pytest.skip("the interpreter of Triton 3.2, of torch 2.6, needs NumPy below 2.4: pip install 'numpy<2.4'")


def _release(package: ModuleType) -> tuple[int, ...]:
    """Major and minor version of a package."""
    return tuple(int(number) for number in str(package.__version__).split(".")[:2])
