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
from torch import Tensor

from mkc_torch.linear._blocks import (
    Block,
    CurvatureSums,
    Density,
    PassResult,
    ResidualRange,
    Sums,
    added,
    curvature_sums,
    is_plain,
    kernel,
    residual,
    residual_range,
    sums,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jaxtyping import Float, Float64, Shaped

VALUES = 1 << 15
"""Values in a block: 2.4 MB with nine columns. Half as many take 20 % longer, twice as many 40 %."""

_KERNEL_COLUMNS = 32
"""Largest number of columns of the kernel."""

VALUES_ON_DEVICE = 1 << 21
"""The same on an accelerator, where each operation has a cost of its own."""


@dataclass(frozen=True)
class Rows:
    """Rows of one problem, tensors or arrays; sums are formed of X times ``frame``, and coefficients refer to those."""

    X: Shaped[Any, "N m n"]
    Y: Shaped[Any, "N m"]
    weight: Shaped[Any, "N m"] | None
    frame: Float64[Tensor, "n n"] | None = None

    def blocks(self) -> Iterator[Block]:
        return blocks(self.X, self.Y, self.weight, self.frame)

    def range_at(self, coef: Float64[Tensor, " n"]) -> ResidualRange:
        """Range of the residuals, in a pass of half the time."""
        if runs_kernel(self):
            extent = self.evaluate(coef, Density(*torch.ones(2, 1, dtype=torch.float64))).extent
            assert extent is not None
            return extent
        total: ResidualRange | None = None
        for block in self.blocks():
            part = residual_range(block, residual(block, coef.to(block.y.device)))
            total = part if total is None else total.with_others(part)
        assert total is not None
        return ResidualRange(total.low.cpu(), total.high.cpu())

    def evaluate(
        self,
        beta: Float64[Tensor, " n"],
        density: Density,
        *,
        with_curvature: bool = False,
        with_range: bool = False,
        weights: Float[Tensor, "N m"] | None = None,
    ) -> PassResult:
        """Make one pass: return the sums and what else is wanted; write the weights to ``weights``.

        Coefficients, density and results are on the CPU.
        """
        if runs_kernel(self):
            # the module needs Triton
            from mkc_torch.linear._fused_pass import fused_pass

            weight = None if self.weight is None else self.weight[:, 0]
            return fused_pass(
                self.X[:, 0], self.Y[:, 0], weight, beta, density, with_curvature=with_curvature, weights=weights
            )
        if isinstance(self.Y, Tensor):
            beta, density = beta.to(self.Y.device), Density(*(value.to(self.Y.device) for value in density))
        total: Sums | None = None
        more: CurvatureSums | None = None
        extent: ResidualRange | None = None
        first, plain = 0, is_plain(density.kappa)
        for block in self.blocks():
            error = residual(block, beta)
            q, w = kernel(error, density)
            if with_curvature:
                more = added(more, curvature_sums(block, error, q, w, density))
            if with_range:
                part = residual_range(block, error)
                extent = part if extent is None else extent.with_others(part)
            if weights is not None:
                weights[first : first + w.shape[0]] = w
                first += w.shape[0]
            total = added(total, sums(block, error, q, w, density, plain=plain))
        assert total is not None
        return PassResult(
            Sums(*(value.cpu() for value in total)),
            None if more is None else CurvatureSums(*(value.cpu() for value in more)),
            None if extent is None else ResidualRange(*(value.cpu() for value in extent)),
        )


def blocks(
    X: Shaped[Any, "N m n"],
    Y: Shaped[Any, "N m"],
    weight: Shaped[Any, "N m"] | None,
    frame: Float64[Tensor, "n n"] | None = None,
    values: int | None = None,
) -> Iterator[Block]:
    """Yield rows times ``frame``, targets and weights in blocks of ``values`` values."""
    if values is None:
        values = VALUES if not isinstance(Y, Tensor) or Y.device.type == "cpu" else VALUES_ON_DEVICE
    step = max(1, values // Y.shape[-1])
    for first in range(0, Y.shape[0], step):
        part = slice(first, first + step)
        rows = as_float64(X[part])
        yield Block(
            rows if frame is None else torch.matmul(rows, frame.to(rows.device)),
            as_float64(Y[part]),
            None if weight is None else as_float64(weight[part]),
        )


def as_float64(values: Shaped[Any, ...]) -> Float64[Tensor, ...]:
    """A tensor in float64; an array is copied, since a tensor of a read-only array warns."""
    return values.double() if isinstance(values, Tensor) else torch.from_numpy(np.array(values, np.float64))


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
