"""Solve the affine recurrence of a trajectory's states by parallel composition."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

_FEW = 256
"""Number of grid times up to which products over 1, 2, 4 ... intervals are cheaper than halving."""


@dataclass(frozen=True)
class Recurrence:
    """The recurrence ``δ[k+1] = A[k] δ[k] − B[k] D[k]``, composed for parallel solution.

    Neighbouring intervals are composed until at most ``_FEW`` times are left, at a few times the work of sequential
    steps. These are composed over 1, 2, 4 … intervals, which takes fewer operations.

    Attributes:
        carries: A at all grid times, at every second time, and so on.
        products: products of A over 1, 2, 4 ... intervals at the last level.
        inverse: B.
    """

    carries: tuple[Tensor, ...]
    products: tuple[Tensor, ...]
    inverse: Tensor

    @classmethod
    def of(cls, carries: Float[Tensor, "G n n"], inverse: Float[Tensor, "G-1 n n"], longest: int) -> Recurrence:
        """Compose from A into each grid time, B, and the number of grid times of the longest trajectory."""
        levels = []
        while longest > _FEW:
            levels.append(carries)
            carries = carries[1::2] @ carries[: len(carries) // 2 * 2 : 2]
            longest = longest // 2 + 1
        products, shift = [], 1
        while shift < longest:
            products.append(carries[shift:])
            carries = torch.cat([carries[:shift], carries[shift:] @ carries[:-shift]])
            shift *= 2
        return cls(tuple(levels), tuple(products), inverse)

    def solved(self, start: Float[Tensor, "G n"], defect: Float[Tensor, "G-1 n"]) -> Float[Tensor, "G n"]:
        source = _applied(self.inverse, defect)
        return self._passed_on(start - torch.cat([torch.zeros_like(source[:1]), source]), 0)

    def _passed_on(self, values: Float[Tensor, "G n"], level: int) -> Float[Tensor, "G n"]:
        if level < len(self.carries):
            A = self.carries[level]
            first = values[::2]
            second = values[1::2] + _applied(A[1::2], first[: len(values) // 2])
            second = self._passed_on(second, level + 1)
            later = first[1:] + _applied(A[2::2], second[: len(first) - 1])
            return _in_turn(torch.cat([first[:1], later]), second)
        shift = 1
        for product in self.products:
            later = _applied(product, values[:-shift])
            values = torch.cat([values[:shift], values[shift:] + later])
            shift *= 2
        return values


def _applied(matrices: Float[Tensor, "G n n"], values: Float[Tensor, "G n"]) -> Float[Tensor, "G n"]:
    return torch.matmul(matrices, values.unsqueeze(-1)).squeeze(-1)


def _in_turn(first: Float[Tensor, "G n"], second: Float[Tensor, "H n"]) -> Float[Tensor, "G+H n"]:
    """Interleave the rows of two tensors; the first may have a row more."""
    paired = torch.stack([first[: len(second)], second], 1).flatten(0, 1)
    return torch.cat([paired, first[len(second) :]])
