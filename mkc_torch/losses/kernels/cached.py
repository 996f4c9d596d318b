"""Launch of a Triton kernel without Triton's look-up of the compiled form, which dominates for small batches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import triton
from torch import Tensor

_INT32 = 2**31
_BY_POSITION = tuple(int(part) for part in triton.__version__.split(".")[:2]) >= (3, 3)
"""Whether a compiled kernel takes its constants as arguments: from Triton 3.3 on."""


class CachedKernel:
    """A Triton kernel with a cache of its compiled forms.

    Triton compiles a form for each combination of dtypes and alignment of pointers, of numbers that are 1, multiples of
    16 or beyond 32 bits, and of constants. The key of the cache contains all of these. Pointers are passed as numbers,
    which need no look-up.

    Args:
        kernel: a function under ``triton.jit`` whose parameters are tensors, then numbers, then constants.
    """

    def __init__(self, kernel: Any) -> None:
        self.kernel = kernel
        self._compiled: dict[Any, Any] = {}

    @property
    def is_interpreted(self) -> bool:
        """Whether Triton's interpreter runs the kernel."""
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
            grid: number of programs along three axes.
            tensors, numbers, constants: arguments of the kernel, in order.
            warps: warps per program.
        """
        device = tensors[0].device
        if device.type == "cuda" and torch.cuda.current_device() != device.index:
            with torch.cuda.device(device):
                return self.launch(grid, tensors, numbers, constants, warps)
        if self.is_interpreted:
            self.kernel[grid](*tensors, *numbers, *constants, num_warps=warps)
            return None
        addresses = [tensor.data_ptr() for tensor in tensors]
        key = (
            device.index,
            warps,
            constants,
            *[tensor.dtype for tensor in tensors],
            *[address % 16 == 0 for address in addresses],
            *[(number == 1, number % 16 == 0, number >= _INT32) for number in numbers],
        )
        compiled = self._compiled.get(key)
        if compiled is None:
            self._compiled[key] = self.kernel[grid](*tensors, *numbers, *constants, num_warps=warps)
        elif _BY_POSITION:
            compiled[grid](*addresses, *numbers, *constants)
        else:
            compiled[grid](*addresses, *numbers)
        return None
