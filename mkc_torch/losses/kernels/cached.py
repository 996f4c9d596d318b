"""Launching a Triton kernel without the search for its compiled form, which takes most of the time of a small batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import triton
from torch import Tensor

__all__ = ["CachedKernel"]

_INT32 = 2**31
_BY_POSITION = tuple(int(part) for part in triton.__version__.split(".")[:2]) >= (3, 3)
"""Whether a compiled kernel takes its constants among its arguments, as it does from Triton 3.3 on."""


class CachedKernel:
    """A Triton kernel whose compiled forms are kept by all that they are compiled for.

    Triton compiles for the dtypes and the alignment of pointers, for numbers that are 1, multiples of 16 or beyond 32
    bits, and for constants. All of them are in the key here. Pointers are passed as numbers, which need no look-up.

    Args:
        kernel: a function under ``triton.jit`` whose parameters are tensors, then numbers, then constants.
    """

    def __init__(self, kernel: Any) -> None:
        self.kernel = kernel
        self._compiled: dict[Any, Any] = {}

    @property
    def is_interpreted(self) -> bool:
        """Whether Triton's interpreter runs it."""
        return not isinstance(self.kernel, triton.JITFunction)

    def launch(
        self,
        grid: tuple[int, int, int],
        tensors: Sequence[Tensor],
        numbers: Sequence[float],
        constants: tuple[Any, ...],
        warps: int,
    ) -> None:
        """Run the kernel on the device and the current stream of the first tensor.

        Args:
            grid: programs along three axes.
            tensors, numbers, constants: arguments of the kernel, in its order.
            warps: warps of a program.
        """
        device = tensors[0].device
        if device.type == "cuda" and torch.cuda.current_device() != device.index:
            with torch.cuda.device(device):
                return self.launch(grid, tensors, numbers, constants, warps)
        if self.is_interpreted:
            self.kernel[grid](*tensors, *numbers, *constants, num_warps=warps)
            return None
        addresses = [one.data_ptr() for one in tensors]
        key = (
            device.index,
            warps,
            constants,
            *[one.dtype for one in tensors],
            *[address % 16 == 0 for address in addresses],
            *[(one == 1, one % 16 == 0, one >= _INT32) for one in numbers],
        )
        compiled = self._compiled.get(key)
        if compiled is None:
            self._compiled[key] = self.kernel[grid](*tensors, *numbers, *constants, num_warps=warps)
        elif _BY_POSITION:
            compiled[grid](*addresses, *numbers, *constants)
        else:
            compiled[grid](*addresses, *numbers)
        return None
