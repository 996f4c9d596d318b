"""Selection of the implementation of a loss: torch's operations, its compiler, or Triton kernels."""

from __future__ import annotations

import functools
from importlib.util import find_spec
from typing import Literal, get_args

import torch
from torch import Tensor, nn

Implementation = Literal["auto", "eager", "compile", "triton"]


def checked_implementation(impl: str) -> Implementation:
    """Return ``impl`` after a check.

    Raises:
        ValueError: the implementation does not exist, or Triton is not installed.
    """
    if impl not in get_args(Implementation):
        known = ", ".join(map(repr, get_args(Implementation)))
        raise ValueError(f"Expected argument `impl` to be one of {known} but got {impl!r}; 'auto' chooses.")
    if impl == "triton" and find_spec("triton") is None:
        raise ValueError(
            "Expected argument `impl` to be 'auto', 'eager' or 'compile' without Triton but got 'triton'; torch's CUDA "
            "wheels bring it, and `pip install triton` runs its interpreter on the CPU."
        )
    return impl  # type: ignore[return-value]


@functools.cache
def kernels_are_available() -> bool:
    """Whether Triton and a GPU are available."""
    return find_spec("triton") is not None and torch.cuda.is_available()


def runs_kernels(loss: nn.Module, input: object) -> bool:
    """Whether the Triton kernels compute this batch."""
    impl = loss.impl
    if impl == "triton":
        return True
    return impl == "auto" and isinstance(input, Tensor) and input.device.type == "cuda" and kernels_are_available()
