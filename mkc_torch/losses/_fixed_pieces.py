"""Large batches of a loss with given σ and d on the CPU: energy and gradient in a few passes over cached pieces.

Memory for each intermediate result takes longer to get than the arithmetic, so all pieces share two buffers. Of the two
exponentials, ``expm1`` takes most of the time. It is needed only where the energies are small: elsewhere one minus the
inlier weight has as many digits.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

PIECE = 1 << 18
"""Elements per piece."""

ROW = 256
"""Approximate length of a piece's rows, made of repeated channels: operations on short rows take twice as long."""

LEAST_ENERGY = 0.02
"""Mean energy of a channel in a piece, as a share of its limit σ², below which ``expm1`` computes it: the error of one
minus the inlier weight, 3e-8, is random and averages out."""


class Piece(NamedTuple):
    """Rows from ``first`` to ``last`` of a batch (N, m), of which ``repeats`` make a row of the piece."""

    first: int
    last: int
    repeats: int


def pieces(rows: int, channels: int) -> Iterator[Piece]:
    """Pieces of a batch (rows, channels), in order.

    Example:
        >>> [(piece.last - piece.first, piece.repeats) for piece in pieces(100_003, 2)]
        [(99968, 128), (35, 1)]
    """
    repeats = max(ROW // channels, 1)
    whole = rows // repeats * repeats
    for r, start, end in ((repeats, 0, whole), (1, whole, rows)):
        size = max(PIECE // (r * channels), 1) * r
        for first in range(start, end, size):
            yield Piece(first, min(first + size, end), r)


def fixed_sums(
    input: Float[Tensor, "N m"],
    target: Float[Tensor, "N m"],
    kappa: Float[Tensor, " m"],
    d: Float[Tensor, " m"],
    divisor: float,
    *,
    wants_input: bool,
) -> tuple[Float[Tensor, " m"], Float[Tensor, "N m"] | None]:
    """Sums of the energies of each channel, and the gradient of their sum divided by ``divisor``.

    Args:
        input, target: contiguous predictions and targets.
        kappa, d: 1/σ² > 0 and d, in the dtype of the input.
        divisor: divisor of the gradient.
        wants_input: whether the gradient is needed; else it is None.
    """
    m = input.shape[-1]
    by_input = torch.empty_like(input) if wants_input else None
    zero, one = input.new_zeros(()), input.new_ones(())
    outlier = torch.zeros(m, dtype=torch.float64)
    root = (0.5 * kappa).sqrt()  # not squares of d, which leave the range of numbers
    ratio = minus_x = input.new_empty(0)
    for first, last, repeats in pieces(len(input), m):
        shape = (-1, repeats * m)
        left, right = input[first:last].view(shape), target[first:last].view(shape)
        if ratio.shape != left.shape:
            ratio, minus_x = torch.empty_like(left), torch.empty_like(left)
            to_ratio, factor = (root / d).repeat(repeats), (1.0 / (root * d * divisor)).repeat(repeats)
        torch.sub(left, right, out=ratio).mul_(to_ratio)
        torch.addcmul(zero, ratio, ratio, value=-1.0, out=minus_x)
        if by_input is None:
            torch.exp(minus_x, out=minus_x)
            torch.sub(one, minus_x, out=minus_x)
        else:
            slope = by_input[first:last].view(shape)
            torch.exp(minus_x, out=slope)
            torch.sub(one, slope, out=minus_x)
            slope.mul_(ratio).mul_(factor)
        found = _by_channel(minus_x, m)
        if bool((found < LEAST_ENERGY * (last - first)).any()):
            torch.addcmul(zero, ratio, ratio, value=-1.0, out=minus_x)
            found = -_by_channel(torch.expm1(minus_x, out=minus_x), m)
        outlier += found
    return outlier / kappa, by_input


def _by_channel(values: Tensor, channels: int) -> Float[Tensor, " m"]:
    return values.sum(0).double().view(-1, channels).sum(0)
