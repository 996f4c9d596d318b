"""Rows of one regression problem, of any type and on any device, and the sums over them in one pass.

On a CPU a block of rows stays in the processor's cache while its residual, weights and sums are computed, so a pass
reads the data once. On a GPU a pass is a kernel (``_fused_pass``). All sums are float64 whatever the type of the rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.lib.stride_tricks import as_strided
from torch import Tensor

from mkc_torch.linear._block_sums import BlockSums, Memory
from mkc_torch.linear._blocks import Block, Density, PassResult

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jaxtyping import Float, Float64, Shaped

VALUES = 1 << 15
"""Values in a block: 2.4 MB with nine columns. Half as many take 20 % longer, twice as many take as long."""

_KERNEL_COLUMNS = 32
"""Largest number of columns of the kernel."""

_MOST_CHANNELS = 4
"""Number of channels from which a block on a CPU has no fewer rows."""

VALUES_ON_DEVICE = 1 << 21
"""Values in a block on an accelerator."""


@dataclass(frozen=True)
class Rows:
    """Rows of one problem, tensors or arrays; sums are formed of X times ``frame``, and coefficients refer to those."""

    X: Shaped[Any, "N m n"]
    Y: Shaped[Any, "N m"]
    weight: Shaped[Any, "N m"] | None
    frame: Float64[Tensor, "n n"] | None = None

    @property
    def is_single(self) -> bool:
        """Whether a rough pass over these rows is in float32."""
        on_cpu = not isinstance(self.Y, Tensor) or self.Y.device.type == "cpu"
        given = (self.X, self.Y) if self.weight is None else (self.X, self.Y, self.weight)
        return on_cpu and self.frame is None and all(part.dtype in (np.float32, torch.float32) for part in given)

    def evaluate(
        self,
        beta: Float64[Tensor, " n"],
        density: Density,
        *,
        with_curvature: bool = False,
        with_range: bool = False,
        weights: Float[Tensor, "N m"] | None = None,
        memory: Memory | None = None,
        rough: bool = False,
    ) -> PassResult:
        """Make one pass: return the sums and what else is requested; write the weights to ``weights``.

        Coefficients, density and results are on the CPU; ``memory`` is used again by the next batch. A ``rough`` pass
        over float32 rows forms products in float32, in half the time; the sums of blocks are added in float64.
        """
        if runs_kernel(self):
            # the module needs Triton
            from mkc_torch.linear._fused_pass import fused_pass

            weight = None if self.weight is None else self.weight[:, 0]
            return fused_pass(
                self.X[:, 0], self.Y[:, 0], weight, beta, density, with_curvature=with_curvature, weights=weights
            )
        memory = Memory() if memory is None else memory
        device = self.Y.device if isinstance(self.Y, Tensor) else torch.device("cpu")
        dtype = torch.float32 if rough and not with_curvature and self.is_single else torch.float64
        total = BlockSums(beta, density, memory, device, dtype, with_curvature=with_curvature, with_range=with_range)
        first = 0
        given = (self.X, self.Y, self.weight)
        for block in single_blocks(*given) if dtype == torch.float32 else blocks(*given, self.frame, memory=memory):
            part = slice(first, first + len(block.y))
            total.add(block, None if weights is None else weights[part])
            first = part.stop
        return total.result()


def blocks(
    X: Shaped[Any, "N m n"],
    Y: Shaped[Any, "N m"],
    weight: Shaped[Any, "N m"] | None,
    frame: Float64[Tensor, "n n"] | None = None,
    values: int | None = None,
    memory: Memory | None = None,
) -> Iterator[Block]:
    """Yield rows times ``frame``, targets and weights in blocks of ``values`` values; the next block reuses memory."""
    memory = Memory() if memory is None else memory
    if values is not None:
        step = max(1, values // Y.shape[-1])
    elif not isinstance(Y, Tensor) or Y.device.type == "cpu":
        step = _rows_at_once(Y)
    else:
        step = max(1, VALUES_ON_DEVICE // Y.shape[-1])
    table = _joined(X, Y)
    for first in range(0, Y.shape[0], step):
        part = slice(first, first + step)
        own = None if weight is None else _converted("weight", (weight[part],), memory)
        rows, y, joined = X[part], Y[part], None
        if not (_is_ready(rows) and _is_ready(y)):
            joined = _converted("rows", (rows, y) if table is None else (table[part],), memory)
            rows, y = joined[..., :-1], joined[..., -1]
        if frame is not None:
            rows = torch.matmul(rows, frame.to(rows.device), out=memory.of("framed", rows.shape, rows.device))
        yield Block(rows, y, own, joined)


def _rows_at_once(Y: Shaped[Any, "N m"]) -> int:
    """Rows of a block on a CPU, where each operation is on one channel and takes a microsecond or two."""
    return max(1, VALUES // min(Y.shape[-1], _MOST_CHANNELS))


def single_blocks(X: Shaped[Any, "N m n"], Y: Shaped[Any, "N m"], weight: Shaped[Any, "N m"] | None) -> Iterator[Block]:
    """Yield float32 rows on a CPU as blocks of arrays, twice as long and without a copy."""
    arrays = [None if part is None else np.asarray(part) for part in (X, Y, weight)]
    step = 2 * _rows_at_once(Y)
    for first in range(0, Y.shape[0], step):
        yield Block(*(None if part is None else part[first : first + step] for part in arrays))  # type: ignore[arg-type]


def _is_ready(values: Shaped[Any, ...]) -> bool:
    """Whether the values are a float64 tensor, in which rows are contiguous."""
    return isinstance(values, Tensor) and values.dtype == torch.float64 and (values.dim() < 3 or values.stride(-1) == 1)


def _converted(name: str, parts: tuple[Shaped[Any, ...], ...], memory: Memory) -> Float64[Tensor, ...]:
    """The values, or those of X and y joined, in float64; in ``memory`` unless they are a tensor that is so."""
    if len(parts) == 1 and _is_ready(parts[0]):
        return parts[0]
    values, *more = parts
    shape = (*values.shape[:-1], values.shape[-1] + 1) if more else tuple(values.shape)
    found = memory.of(name, shape, values.device if isinstance(values, Tensor) else "cpu")
    targets = (found[..., :-1], found[..., -1]) if more else (found,)
    for target, part in zip(targets, parts, strict=True):
        if isinstance(part, Tensor):
            target.copy_(part)
        else:
            # a tensor of a read-only array would warn
            np.copyto(target.numpy(), part)
    return found


def _joined(X: Shaped[Any, "N m n"], Y: Shaped[Any, "N m"]) -> Shaped[np.ndarray, "N m k"] | None:
    """[X Y] of one array where Y is the column after X; it is converted in half the time of the parts."""
    if isinstance(X, Tensor) or isinstance(Y, Tensor) or X.dtype != Y.dtype or X.strides[0] != Y.strides[0]:
        return None
    together = X.strides[2] == X.itemsize and X.ctypes.data + X.shape[2] * X.itemsize == Y.ctypes.data
    if not together or (Y.shape[1] > 1 and X.strides[1] != Y.strides[1]):
        return None
    return as_strided(X, (*X.shape[:2], X.shape[2] + 1), X.strides, writeable=False)


def runs_kernel(rows: Rows) -> bool:
    """Whether a pass over these rows is a single kernel: one channel of few columns on a GPU, with Triton."""
    return (
        isinstance(rows.Y, Tensor)
        and rows.Y.is_cuda
        and rows.frame is None
        and rows.Y.shape[-1] == 1
        and rows.X.shape[-1] <= _KERNEL_COLUMNS
        and find_spec("triton") is not None
    )
