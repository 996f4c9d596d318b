"""First pass: check every value, count and sum the rows, compute their triangle and draw a sample.

The triangle of a channel is the R of a QR decomposition of [X y], rows times the roots of their weights. Updated from
block to block, it is as accurate as a decomposition of all rows at once, and determines least squares.

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

from mkc_torch.linear._basis import nearly_dependent
from mkc_torch.linear._block_sums import Memory, products
from mkc_torch.linear._blocks import Block
from mkc_torch.linear._problem import refuse_dependent, refuse_magnitude
from mkc_torch.linear._rows import blocks
from mkc_torch.linear.streaming._batches import Shape, rows_of
from mkc_torch.linear.streaming._reservoir import Reservoir

if TYPE_CHECKING:
    from jaxtyping import Float64

_MANY_COLUMNS = 16
"""Number of columns from which the products of an array with itself are faster than those of two arrays."""

LEAST_PIVOT = 1e-3
"""Least pivot of the Cholesky factor of the scaled products of a block's columns.

Above it the products are as accurate as the rows, to ten digits. Only blocks of nearly dependent columns, or of a
target that the columns explain almost exactly, need a QR decomposition, which takes five times as long."""


@dataclass(frozen=True)
class Survey:
    """Summary of the rows of one rank or of all ranks, from one pass.

    Attributes:
        shape: shape of every batch.
        rows: number of rows.
        used: number of values with positive weight.
        triangle: triangle of each channel's [X y], (m, n + 1, n + 1).
        total: weighted sums of [x y], which identify the rows, (m, n + 1).
        weight: sum of the weights, (m,).
        largest: largest absolute value of Y, (m,).
        single: whether all rows are float32 on a CPU.
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
        """Merge the surveys of all ranks.

        Raises:
            ValueError: the ranks have different columns, or a channel has no value of positive weight.
            RankDeficientError: columns are linearly dependent.
        """
        if not parts:
            raise ValueError("Expected argument `batches` to have rows but got none; pass at least one batch.")
        shape = parts[0].shape
        if any(part.shape != shape for part in parts):
            raise ValueError(
                f"Expected every rank to have the same columns, channels and weights but got "
                f"{[part.shape for part in parts]}; give each rank rows of the same table."
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
        """Matrix that takes coefficients in an orthonormal basis to those of the columns.

        Raises:
            RankDeficientError: columns are linearly dependent.
        """
        n = self.shape.n
        stacked = self.triangle[:, :, :n].reshape(-1, n)
        scale = torch.linalg.vector_norm(stacked, dim=0)
        upper = torch.linalg.qr(stacked / torch.where(scale > 0, scale, 1.0), mode="r").R
        return refuse_dependent(upper, scale, self.rows * self.shape.m) / scale.unsqueeze(-1)

    def frame(self) -> Float64[Tensor, "n n"] | None:
        """Change of basis of every block if the columns are nearly dependent, else None."""
        n = self.shape.n
        return self.to_coef() if nearly_dependent(self.triangle[:, :, :n].reshape(-1, n)) else None

    def sizes(self, coef: Float64[Tensor, " n"]) -> Float64[Tensor, " m"]:
        """Upper bound of the weighted sum of ``|y| + |x| |coef|`` of each channel, by Cauchy-Schwarz."""
        size = (self.weight.unsqueeze(-1) * self.triangle.square().sum(-2)).sqrt()
        return size[:, -1] + size[:, :-1] @ coef.abs()

    def grams(self) -> Float64[Tensor, "m n n"]:
        """Products of the columns of each channel in the basis of the passes, per unit of weight."""
        n, frame = self.shape.n, self.frame()
        rows = self.triangle[:, :, :n] if frame is None else self.triangle[:, :, :n] @ frame
        return rows.mT @ rows / self.weight.sum()


def survey_rows(batches: Iterable[Any], reservoir: Reservoir) -> Survey | None:
    """Survey of this rank's rows, None without rows; the reservoir draws from the same rows.

    Raises:
        TypeError, ValueError: a batch is not like the first, a value is not finite, a weight is negative.
    """
    adding: _GrowingSurvey | None = None
    memory = Memory()
    for number, (shape, rows) in enumerate(rows_of(batches)):
        adding = _GrowingSurvey(shape, memory) if adding is None else adding
        adding.single = adding.single and rows.is_single
        first = 0
        for block in blocks(rows.X, rows.Y, rows.weight, memory=memory):
            adding.add(block, number, first)
            reservoir.add(block)
            first += block.y.shape[0]
    return adding.survey() if adding is not None and adding.rows else None


class _GrowingSurvey:
    """Accumulates the sums of a survey."""

    def __init__(self, shape: Shape, memory: Memory) -> None:
        m, k = shape.m, shape.n + 1
        self._shape, self._memory = shape, memory
        self.rows = self._used = 0
        self.single = True
        self._ones: Tensor | None = None
        self._total, self._weight, self._largest = (torch.zeros(size, dtype=torch.float64) for size in ((m, k), m, m))
        self._triangle, self._gram = (torch.zeros(m, k, k, dtype=torch.float64) for _ in range(2))

    def add(self, block: Block, batch: int, first: int) -> None:
        count, m = block.y.shape
        joined = block.joined
        if joined is None:
            joined = self._memory.of("joined", (count, m, self._shape.n + 1), block.y.device)
            joined[..., :-1], joined[..., -1] = block.rows, block.y
        weighted = joined
        if block.weight is not None:
            weighted = self._memory.of("weighted", tuple(joined.shape), joined.device)
            torch.mul(joined, block.weight.unsqueeze(-1), out=weighted)
        if self._ones is None or len(self._ones) < count:
            self._ones = torch.ones(count, 1, dtype=torch.float64, device=joined.device)
        total = products(self._ones[:count], weighted.flatten(1)).view(m, -1).cpu()
        # checking the sums is much faster than checking every element for NaN and infinity
        if not bool(torch.isfinite(total).all()) or (block.weight is not None and float(block.weight.min()) < 0):
            refuse_bad_values(block, batch, first)
        self.rows += count
        self._total += total
        y = self._memory.of("y", (m, count), block.y.device).copy_(block.y.mT)
        # of a whole tensor, aminmax takes a tenth of the time of that by rows
        largest = torch.stack([torch.stack(torch.aminmax(own)).abs().amax() for own in y])
        self._largest = torch.maximum(self._largest, largest.cpu())
        self._used += count * m if block.weight is None else int((block.weight > 0).sum())
        self._weight += count if block.weight is None else block.weight.sum(0).cpu()
        gram = torch.stack([_products(joined[:, c], weighted[:, c], y[c]) for c in range(m)]).cpu()
        if _is_good(gram):
            self._gram += gram
        else:
            scaled = joined if block.weight is None else joined * block.weight.sqrt().unsqueeze(-1)
            self._join(scaled.transpose(0, 1).cpu())

    def _join(self, rows: Float64[Tensor, "m rows k"]) -> None:
        self._triangle = torch.linalg.qr(torch.cat([self._triangle, rows], dim=-2), mode="r").R

    def survey(self) -> Survey:
        if self._gram.any():
            self._join(torch.linalg.cholesky(self._gram, upper=True))
        sums = self._triangle, self._total, self._weight, self._largest
        return Survey(self._shape, self.rows, self._used, *sums, self.single)


def _products(joined: Tensor, weighted: Tensor, y: Tensor) -> Float64[Tensor, "k k"]:
    """Sums of the products of the columns of [x y], the weighted and the others; those of x come separately.

    NumPy multiplies an array with itself in another way, which is slower for few columns and faster for many.
    """
    if joined.shape[-1] > _MANY_COLUMNS:
        return products(weighted, joined)
    left = products(weighted, joined[:, :-1])
    last = torch.dot(y, weighted[:, -1]).reshape(1)
    return torch.cat([left, torch.cat([left[-1], last]).unsqueeze(-1)], 1)


def _is_good(gram: Float64[Tensor, "m k k"]) -> bool:
    """Whether the Cholesky factor of products of columns has ten digits; sums of such products then have them too."""
    found = gram.numpy()
    size = np.sqrt(np.diagonal(found, axis1=-2, axis2=-1))
    if not (size > 0).all():
        return False
    try:
        factor = np.linalg.cholesky(found / (size[:, :, None] * size[:, None]))
    except np.linalg.LinAlgError:
        return False
    return bool(np.diagonal(factor, axis1=-2, axis2=-1).min() > LEAST_PIVOT)


def refuse_bad_values(block: Block, batch: int, first: int) -> None:
    """Raise an error that names the first NaN or infinite value, or the first negative weight.

    Raises:
        ValueError: there is such a value.
    """
    for name, values in (("X", block.rows), ("Y", block.y), ("weight", block.weight)):
        if values is None:
            continue
        wrong, kind = ~torch.isfinite(values), "finite"
        if name == "weight":
            wrong, kind = wrong | (values < 0), "finite and >= 0"
        if not bool(wrong.any()):
            continue
        row, *inside = (int(i) for i in wrong.nonzero()[0])
        place = f", at {tuple(inside)} in it" if values[0].numel() > 1 else ""
        raise ValueError(
            f"Expected `{name}` to be {kind} but got {float(values[(row, *inside)])} in row {first + row} of batch "
            f"{batch}{place}; drop that row, or give it the weight 0 and a finite value."
        )


def _summed(parts: list[Tensor]) -> Tensor:
    return torch.stack(parts).sum(0)
