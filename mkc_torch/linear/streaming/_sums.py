"""Sums of one pass over batches, as flat numbers that the ranks add up."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mkc_torch.linear._block_sums import Memory
from mkc_torch.linear._blocks import CurvatureSums, Density, PassResult, ResidualRange, Sums
from mkc_torch.linear.streaming._batches import Shape, rows_of

if TYPE_CHECKING:
    from jaxtyping import Float64


def _shapes(shape: Shape) -> tuple[list[tuple[int, ...]], list[tuple[int, ...]]]:
    """Shapes of the fields of :class:`Sums` and of :class:`CurvatureSums`."""
    m, n = shape.m, shape.n
    return [(m,), (m,), (5, m), (m, n)], [(n, n), (n, n), (m, n), (m, n), (m,), (1,)]


def flat_length(shape: Shape, *, with_curvature: bool) -> int:
    """Count of the numbers of :func:`sums_pass`."""
    sums, more = _shapes(shape)
    return 1 + sum(torch.Size(size).numel() for size in sums + (more if with_curvature else []))


def sums_pass(
    batches: Iterable[Any],
    shape: Shape,
    frame: Float64[Tensor, "n n"] | None,
    beta: Float64[Tensor, " n"],
    density: Density,
    *,
    with_curvature: bool = False,
    with_range: bool = False,
    rough: bool = False,
) -> tuple[Float64[Tensor, " k"], ResidualRange | None]:
    """Number of this rank's rows and their sums, and the range of the residuals if wanted and if there are rows.

    Args:
        batches: batches of this rank.
        shape: shape of every batch.
        frame: change of basis of the columns, if any.
        beta, density: point of the pass.
        with_curvature: whether to form the curvature sums too, which takes three times as long.
        with_range: whether to find the range of the residuals.
        rough: whether products of float32 rows are formed in float32.
    """
    flat, extent = torch.zeros(flat_length(shape, with_curvature=with_curvature), dtype=torch.float64), None
    memory = Memory()
    for _, rows in rows_of(batches, shape, frame):
        if len(rows.Y):
            total, more, part = rows.evaluate(
                beta, density, with_curvature=with_curvature, with_range=with_range, memory=memory, rough=rough
            )
            flat[0] += len(rows.Y)
            flat[1:] += torch.cat([value.reshape(-1) for value in (*total, *(more or ()))])
            if part is not None:
                extent = part if extent is None else extent.with_others(part)
    return flat, extent


def sums_of(flat: Float64[Tensor, " k"], shape: Shape) -> tuple[int, PassResult]:
    """Number of rows and sums, from the result of :func:`sums_pass`."""
    sums, more = _shapes(shape)
    shapes = sums + (more if len(flat) == flat_length(shape, with_curvature=True) else [])
    count, *parts = flat.split([1, *(torch.Size(size).numel() for size in shapes)])
    fields = [part.reshape(size) for part, size in zip(parts, shapes, strict=True)]
    found = CurvatureSums(*fields[len(sums) :]) if len(fields) > len(sums) else None
    return int(count), PassResult(Sums(*fields[: len(sums)]), found, None)
