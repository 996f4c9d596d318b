"""A pass over the rows of one channel as a single Triton kernel: residual, weight and all sums, for rows on a GPU.

Rows are read once, in their type, and everything after is float64. Each program adds up its rows, and the sums of the
programs are added in a fixed order, so results are deterministic. One copy to the CPU ends the pass.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.linear._blocks import CurvatureSums, Density, PassResult, ResidualRange, Sums
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

_SCALARS = 9
"""Sums per program that are not of columns; two are the range of the residuals."""

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
    """The sums of a pass over rows of one channel; results are on the CPU, and the range is always included.

    Args:
        x, y, weight: rows, of any strides.
        beta, density: point of the pass, on the CPU.
        with_curvature: whether to form the curvature sums.
        weights: filled with the weights of the density, contiguous.
    """
    n = x.shape[1]
    columns = max(1 << (n - 1).bit_length(), 2)
    block = min(_BLOCK, max(_LEAST_BLOCK, _PRODUCTS // columns**2)) if with_curvature else _BLOCK
    programs = min(_PROGRAMS, -(-len(y) // block))
    length = _SCALARS + n + (2 * n * n + 2 * n + 2 if with_curvature else 0)
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
    low, high, total, residual = (flat[i : i + 1] for i in range(4))
    sums = Sums(total, residual, flat[4:_SCALARS].unsqueeze(-1), flat[_SCALARS : _SCALARS + n].unsqueeze(0))
    if not with_curvature:
        return PassResult(sums, None, ResidualRange(low, high))
    curvature, spread, tilt, moment, square, light = flat[_SCALARS + n :].split([n * n, n * n, n, n, 1, 1])
    more = CurvatureSums(curvature.view(n, n), spread.view(n, n), tilt.unsqueeze(0), moment.unsqueeze(0), square, light)
    return PassResult(sums, more, ResidualRange(low, high))
