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
from mkc_torch.linear.streaming._blocks import Shape, StreamBlock, blocks
from mkc_torch.linear.streaming._reservoir import Reservoir

if TYPE_CHECKING:
    from jaxtyping import Float64

__all__ = ["Survey", "surveyed"]

NEARLY_DEPENDENT = 1e5
"""Ratio of the singular values of the scaled columns above which they are turned in every block: sums of products of
the columns as they are lose digits by its square, ten of sixteen here."""

LEAST_PIVOT = 1e-3
"""Of Cholesky's factor of the scaled products of a block's columns. Above it the products say as much as the rows, to
ten digits; only blocks of nearly dependent columns, or of a target that they all but explain, need a QR decomposition,
which takes five times as long."""


@dataclass(frozen=True)
class Survey:
    """What one pass says of rows, of one rank or of all.

    Attributes:
        shape: of every batch.
        rows: their number.
        used: values of a positive weight.
        triangle: of each channel's [X y], (m, n + 1, n + 1).
        total: weighted sums of [x y], (m, n + 1), by which the rows are known again.
        weight: sums of the weights, (m,).
        largest: absolute values of Y, (m,).
        single: all are of float32.
    """

    shape: Shape
    rows: int
    used: int
    triangle: Float64[Tensor, "m k k"]
    total: Float64[Tensor, "m k"]
    weight: Float64[Tensor, " m"]
    largest: Float64[Tensor, " m"]
    single: bool

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
            weight=_summed([part.weight for part in parts]),
            largest=torch.stack([part.largest for part in parts]).amax(0),
            single=all(part.single for part in parts),
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

    def is_turned(self) -> bool:
        """Whether the columns are so nearly dependent that they are turned in every block."""
        n = self.shape.n
        stacked = self.triangle[:, :, :n].reshape(-1, n)
        singular = torch.linalg.svdvals(stacked / torch.linalg.vector_norm(stacked, dim=0))
        return bool(singular[0] > NEARLY_DEPENDENT * singular[n - 1])


def surveyed(batches: Iterable[Any], reservoir: Reservoir) -> Survey | None:
    """The survey of this rank's rows, None of no rows; the reservoir gets to see each of them.

    Raises:
        TypeError, ValueError: a batch is not like the first, a value is not finite, a weight is negative.
    """
    adding: _GrowingSurvey | None = None
    for shape, block in blocks(batches):
        adding = _GrowingSurvey(shape) if adding is None else adding
        adding.add(block)
        reservoir.add(block)
    return None if adding is None else adding.survey()


class _GrowingSurvey:
    """The sums of a survey while they grow."""

    def __init__(self, shape: Shape) -> None:
        m, k = shape.m, shape.n + 1
        self._shape = shape
        self._rows = self._used = 0
        self._single = True
        self._total, self._weight, self._largest = np.zeros((m, k)), np.zeros(m), np.zeros(m)
        self._triangle, self._gram = torch.zeros(m, k, k, dtype=torch.float64), np.zeros((m, k, k))
        self._space = np.empty(0)

    def add(self, block: StreamBlock) -> None:
        joined = block.joined
        m, _, count = joined.shape
        if self._space.size < joined.size:
            self._space = np.empty(joined.size)
        weighted = self._space[: joined.size].reshape(joined.shape)
        own = np.ones((m, count)) if block.weight is None else block.weight
        total = np.matmul(joined, own[:, :, None])[:, :, 0]
        # a sum says in a fraction of the time that no element is NaN or infinite
        if not np.isfinite(total).all() or own.min() < 0:
            refuse_bad_values(block)
        self._rows += count
        self._single = self._single and block.single
        self._total += total
        self._largest = np.maximum(self._largest, np.maximum(block.Y.max(1), -block.Y.min(1)))
        self._used += int(np.count_nonzero(own > 0))
        self._weight += own.sum(1)
        gram = np.matmul(np.multiply(joined, own[:, None], out=weighted), joined.transpose(0, 2, 1))
        if _is_good(gram):
            self._gram += gram
        else:
            np.multiply(joined, np.sqrt(own)[:, None], out=weighted)
            self._join(torch.from_numpy(weighted).mT)

    def _join(self, rows: Float64[Tensor, "m rows k"]) -> None:
        self._triangle = torch.linalg.qr(torch.cat([self._triangle, rows], dim=-2), mode="r").R

    def survey(self) -> Survey:
        if self._gram.any():
            self._join(torch.linalg.cholesky(torch.from_numpy(self._gram), upper=True))
        total, weight, largest = map(torch.from_numpy, (self._total, self._weight, self._largest))
        return Survey(self._shape, self._rows, self._used, self._triangle, total, weight, largest, self._single)


def _is_good(gram: Float64[np.ndarray, "m k k"]) -> bool:
    """Whether Cholesky's factor of products of columns has ten digits; sums of such products have it too."""
    size = np.sqrt(np.diagonal(gram, axis1=-2, axis2=-1))
    if not (size > 0).all():
        return False
    try:
        factor = np.linalg.cholesky(gram / (size[:, :, None] * size[:, None]))
    except np.linalg.LinAlgError:
        return False
    return bool(np.diagonal(factor, axis1=-2, axis2=-1).min() > LEAST_PIVOT)


def refuse_bad_values(block: StreamBlock) -> None:
    """Name the first value that is NaN or infinite, or the first negative weight.

    Raises:
        ValueError: there is one.
    """
    for name, values in (("X", block.X), ("Y", block.Y), ("weight", block.weight)):
        if values is None:
            continue
        wrong, kind = ~np.isfinite(values), "finite"
        if name == "weight":
            wrong, kind = wrong | (values < 0), "finite and >= 0"
        if not wrong.any():
            continue
        *inside, row = (int(i) for i in min(np.argwhere(wrong), key=lambda at: int(at[-1])))
        place = f", at {tuple(inside)} in it" if np.prod(values.shape[:-1]) > 1 else ""
        raise ValueError(
            f"Expected `{name}` to be {kind} but got {values[(*inside, row)]} in row {block.first + row} of batch "
            f"{block.batch}{place}; leave that row out, or give it the weight 0 and a finite value."
        )


def _summed(parts: list[Tensor]) -> Tensor:
    return torch.stack(parts).sum(0)
