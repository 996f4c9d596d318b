"""A pass over the rows of one channel as a single Triton kernel: residual, weight and all sums, for rows on a GPU.

Rows are read once, in their type, and everything after is float64. Each program adds up its rows, and the sums of the
programs are added in a fixed order, so results are deterministic. One copy to the CPU ends the pass.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.linear._blocks import Density, PassResult, ResidualRange, flat_length
from mkc_torch.linear._pass_kernel import pass_kernel
from mkc_torch.linear.summary import LIGHT
from mkc_torch.losses.kernels.cached import CachedKernel

if TYPE_CHECKING:
    from jaxtyping import Float, Float64

_PROGRAMS = 1024
"""Largest number of programs, about eight for each multiprocessor."""

_WARPS = 4
"""Warps per program."""

_BLOCK = 128
"""Rows of a block: a row for each thread, at which no compiled form for an H100 spills registers."""

_PRODUCTS = 2048
"""Largest number of products of two columns in a block of a pass with curvature, for the same reason."""

_LEAST_BLOCK = 4
"""Rows of a block, at least."""

_KERNEL = CachedKernel(pass_kernel)


def fused_pass(
    x: Float[Tensor, "N n"],
    y: Float[Tensor, " N"],
    weight: Float[Tensor, " N"] | None,
    beta: Float64[Tensor, " n"],
    density: Density,
    *,
    with_curvature: bool,
    weights: Float[Tensor, "N 1"] | None = None,
) -> PassResult:
    """The sums of a pass over rows of any strides, with the range; the point and the results are on the CPU.

    ``weights``, contiguous, are filled with the weights of the density.
    """
    n = x.shape[1]
    columns = max(1 << (n - 1).bit_length(), 2)
    block = min(_BLOCK, max(_LEAST_BLOCK, _PRODUCTS // columns**2)) if with_curvature else _BLOCK
    programs = min(_PROGRAMS, -(-len(y) // block))
    # the two ends of the range come first
    length = 2 + flat_length(1, n, with_curvature=with_curvature)
    point = torch.cat([density.kappa, 0.5 / density.d.square(), beta]).to(y.device)
    partial = torch.empty(programs, length, dtype=torch.float64, device=y.device)
    _KERNEL.launch(
        (programs, 1, 1),
        (x, y, y if weight is None else weight, point, partial, y if weights is None else weights),
        (len(y), *x.stride(), y.stride(0), 0 if weight is None else weight.stride(0), length),
        (n, columns, block, weight is not None, with_curvature, weights is not None, LIGHT),
        _WARPS,
    )
    flat = torch.cat([partial[:, :1].amin(0), partial[:, 1:2].amax(0), partial[:, 2:].sum(0)]).cpu()
    return PassResult.of_flat(flat[2:], 1, n, ResidualRange(flat[:1], flat[1:2]))
