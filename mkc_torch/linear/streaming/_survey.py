"""The first pass: every value is checked, rows are counted and summed, their triangle is made and some are drawn.

The triangle of a channel is the R of a QR decomposition of [X y], rows times the roots of their weights. It is carried
from block to block, so that it is as accurate as one of all rows at once, and says everything of least squares.

Demmel, Grigori, Hoemmen & Langou, "Communication-optimal parallel and sequential QR and LU factorizations", SIAM J.
Sci. Comput. 34 (2012).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from mkc_torch.linear._problem import refuse_dependent, refuse_magnitude
from mkc_torch.linear.streaming._blocks import Block, Shape, blocks
from mkc_torch.linear.streaming._reservoir import Reservoir

if TYPE_CHECKING:
    from jaxtyping import Float64

__all__ = ["Survey", "surveyed"]


@dataclass(frozen=True)
class Survey:
    """What one pass says of rows, of one rank or of all.

    Attributes:
        shape: of every batch.
        rows: their number.
        used: values of a positive weight.
        triangle: of each channel's [X y], (m, n + 1, n + 1).
        total: sums of [x y], (m, n + 1), by which the rows are known again.
        size: sums of the absolute values, (m, n + 1): what these sums are accurate to.
        weight: sums of the weights, (m,).
        largest: absolute values of Y, (m,).
    """

    shape: Shape
    rows: int
    used: int
    triangle: Float64[Tensor, "m k k"]
    total: Float64[Tensor, "m k"]
    size: Float64[Tensor, "m k"]
    weight: Float64[Tensor, " m"]
    largest: Float64[Tensor, " m"]

    @staticmethod
    def of_all(parts: list[Survey]) -> Survey:
        """That of all ranks.

        Raises:
            ValueError: the ranks have other columns, or there is no value of positive weight in some channel.
            RankDeficientError: columns are linearly dependent.
        """
        if not parts:
            raise ValueError("Expected argument `batches` to have rows but got none; there is nothing to fit.")
        shape = parts[0].shape
        if any(part.shape != shape for part in parts):
            raise ValueError(
                f"Expected every rank to have the same columns, channels and weights but got "
                f"{[part.shape for part in parts]}; give each rank rows of one table."
            )
        triangle = parts[0].triangle
        for part in parts[1:]:
            triangle = torch.linalg.qr(torch.cat([triangle, part.triangle], dim=-2), mode="r").R
        whole = Survey(
            shape=shape,
            rows=sum(part.rows for part in parts),
            used=sum(part.used for part in parts),
            triangle=triangle,
            total=_summed([part.total for part in parts]),
            size=_summed([part.size for part in parts]),
            weight=_summed([part.weight for part in parts]),
            largest=torch.stack([part.largest for part in parts]).amax(0),
        )
        whole._check()
        return whole

    def _check(self) -> None:
        m, n = self.shape.m, self.shape.n
        if self.rows * m < n:
            raise ValueError(
                f"Expected at least {n} values for {n} coefficients but got {self.rows} rows x {m}; add rows."
            )
        if bool((self.weight <= 0).any()):
            raise ValueError("Expected weights to be positive somewhere in every channel but got all zeros.")
        refuse_magnitude(self.largest)
        self.to_coef()

    def to_coef(self) -> Float64[Tensor, "n n"]:
        """Takes coefficients in a basis in which the columns are orthonormal to those of the columns.

        Raises:
            RankDeficientError: columns are linearly dependent.
        """
        n = self.shape.n
        stacked = self.triangle[:, :, :n].reshape(-1, n)
        scale = torch.linalg.vector_norm(stacked, dim=0)
        upper = torch.linalg.qr(stacked / torch.where(scale > 0, scale, 1.0), mode="r").R
        refuse_dependent(upper, scale, self.rows * self.shape.m)
        return torch.linalg.inv(upper) / scale.unsqueeze(-1)


def surveyed(batches: Iterable[Any], reservoir: Reservoir) -> Survey | None:
    """The survey of this rank's rows, None of no rows; the reservoir gets to see each of them.

    Raises:
        TypeError, ValueError: a batch is not like the first, a value is not finite, a weight is negative.
    """
    adding: _Adding | None = None
    for shape, block in blocks(batches):
        adding = _Adding(shape) if adding is None else adding
        adding.add(block)
        reservoir.add(block)
    return None if adding is None else adding.survey()


class _Adding:
    """The sums of a survey while they grow."""

    def __init__(self, shape: Shape) -> None:
        m, k = shape.m, shape.n + 1
        self._shape = shape
        self._rows = self._used = 0
        self._triangle = torch.zeros(m, k, k, dtype=torch.float64)
        self._total, self._size = np.zeros((m, k)), np.zeros((m, k))
        self._weight, self._largest = np.zeros(m), np.zeros(m)

    def add(self, block: Block) -> None:
        refuse_bad_values(block)
        count, m, n = block.X.shape
        joined = np.empty((m, count, n + 1))
        joined[:, :, :n] = block.X.transpose(1, 0, 2)
        joined[:, :, n] = block.Y.T
        ones = np.ones(count)
        self._rows += count
        self._total += ones @ joined
        self._largest = np.maximum(self._largest, np.abs(block.Y).max(0))
        if block.weight is None:
            self._used += count * m
            self._weight += count
        else:
            self._used += int((block.weight > 0).sum())
            self._weight += block.weight.sum(0)
        rows = torch.from_numpy(joined)
        weighted = rows if block.weight is None else rows * torch.from_numpy(np.sqrt(block.weight.T)).unsqueeze(-1)
        self._triangle = torch.linalg.qr(torch.cat([self._triangle, weighted], dim=-2), mode="r").R
        self._size += ones @ np.abs(joined, out=joined)

    def survey(self) -> Survey:
        return Survey(
            self._shape,
            self._rows,
            self._used,
            self._triangle,
            *map(torch.from_numpy, (self._total, self._size, self._weight, self._largest)),
        )


def refuse_bad_values(block: Block) -> None:
    """Name the first value that is NaN or infinite, and the first negative weight.

    Raises:
        ValueError: there is one.
    """
    for name, values in (("X", block.X), ("Y", block.Y), ("weight", block.weight)):
        # a sum says in a fraction of the time that no element is NaN or infinite
        if values is None or (np.isfinite(values.sum()) and not (name == "weight" and values.min() < 0)):
            continue
        wrong = ~np.isfinite(values) if name != "weight" else ~(np.isfinite(values) & (values >= 0))
        if not wrong.any():
            continue
        at = tuple(int(i) for i in np.argwhere(wrong)[0])
        kind = "finite and >= 0" if name == "weight" else "finite"
        inside = f", at {at[1:]} in it" if len(at) > 1 and values[0].size > 1 else ""
        raise ValueError(
            f"Expected `{name}` to be {kind} but got {values[at]} in row {block.first + at[0]} of batch "
            f"{block.batch}{inside}; leave that row out, or give it the weight 0 and a finite value."
        )


def _summed(parts: list[Tensor]) -> Tensor:
    return torch.stack(parts).sum(0)
