"""Affine recurrences of the states of a trajectory, composed by doubling."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["Recurrence"]

_FEW = 256
"""Moments from which on it is cheaper to join them all at once than one half to the other."""


@dataclass(frozen=True)
class Recurrence:
    """The recurrence ``δ[k+1] = A[k] δ[k] − B[k] D[k]``: its A, those of every second moment and so on, and B.

    Neighbours are joined until few are left, which takes a few times the work of one step after the other; those few
    are joined over 1, 2, 4 … intervals, which takes fewer operations.
    """

    carries: tuple[Tensor, ...]
    products: tuple[Tensor, ...]
    inverse: Tensor

    @classmethod
    def of(cls, carries: Float[Tensor, "G n n"], inverse: Float[Tensor, "G-1 n n"], longest: int) -> Recurrence:
        """From A as it arrives at each moment, B, and the number of moments of the longest trajectory."""
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
        pushed = _applied(self.inverse, defect)
        return self._passed_on(start - torch.cat([torch.zeros_like(pushed[:1]), pushed]), 0)

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
            carried = _applied(product, values[:-shift])
            values = torch.cat([values[:shift], values[shift:] + carried])
            shift *= 2
        return values


def _applied(matrices: Float[Tensor, "G n n"], values: Float[Tensor, "G n"]) -> Float[Tensor, "G n"]:
    return torch.matmul(matrices, values.unsqueeze(-1)).squeeze(-1)


def _in_turn(first: Float[Tensor, "G n"], second: Float[Tensor, "H n"]) -> Float[Tensor, "G+H n"]:
    """Rows of the one and of the other, in turn; the first may have one more."""
    paired = torch.stack([first[: len(second)], second], 1).flatten(0, 1)
    return torch.cat([paired, first[len(second) :]])
