"""Rows of a batch of matrices: those at given indices, and linearly independent rows that are preferred by size."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


def taken(rows: Float[Tensor, "B R n"], index: Int[Tensor, "B k"]) -> Float[Tensor, "B k n"]:
    """The rows of each matrix at its indices."""
    return rows.gather(1, index.unsqueeze(-1).expand(-1, -1, rows.shape[-1]))


def independent_rows(
    rows: Float[Tensor, "#B R n"], size: Float[Tensor, "B R"], used: Bool[Tensor, "B R"], tolerance: float
) -> Int[Tensor, "B n"]:
    """Indices of n linearly independent rows: QR that pivots on the length of ``row * size``.

    Args:
        rows: at least n independent rows in use.
        size: preference of each row, 0 for a row that must not be taken.
        used: mask of the rows in use.
        tolerance: share of its length below which the rest of a row counts as dependent.
    """
    left = rows * used.unsqueeze(-1)
    dependent = tolerance * torch.linalg.vector_norm(left, dim=-1)
    chosen = []
    for _ in range(rows.shape[-1]):
        length = torch.linalg.vector_norm(left, dim=-1)
        pivot = torch.where(length > dependent, length * size, 0.0).argmax(-1)
        chosen.append(pivot)
        row = taken(left, pivot.unsqueeze(-1))
        direction = row / torch.linalg.vector_norm(row, dim=-1, keepdim=True)
        left = left - torch.matmul(left, direction.mT) * direction
    return torch.stack(chosen, dim=-1)
