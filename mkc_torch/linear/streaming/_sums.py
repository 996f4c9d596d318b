"""Sums over rows from which the likelihood, its gradient and its Hessian are computed, in one pass.

With ``w = exp(-κ z² / 2)`` the energy is ``(1 - w) / κ``, and each of its derivatives by κ and log d is a combination
of the sums of 1, w, w r² and w r⁴. So a pass needs a few operations per residual r and one per row.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from mkc_torch.density.likelihood import energy_derivatives
from mkc_torch.linear.streaming._blocks import Shape, StreamBlock, blocks
from mkc_torch.linear.summary import LIGHT

if TYPE_CHECKING:
    from jaxtyping import Float64
    from torch import Tensor

__all__ = ["Extremes", "Report", "StreamPoint", "StreamSums", "range_pass", "report_pass", "slopes_pass"]

LEAST_KAPPA = 1e-3
"""Least 1/σ² at which derivatives are differences of sums; below it they are summed term by term.

Differences would lose more than six of sixteen digits there."""


@dataclass(frozen=True)
class StreamPoint:
    """The point of a pass: coefficients, κ = 1/σ² and d of each channel.

    ``to_basis`` changes the basis of the columns, block by block, if they are so nearly dependent that sums of their
    products lose their digits; the coefficients then refer to the new columns.
    """

    coef: Float64[np.ndarray, " n"]
    kappa: Float64[np.ndarray, " m"]
    d: Float64[np.ndarray, " m"]
    to_basis: Float64[np.ndarray, "n n"] | None = None


@dataclass(frozen=True)
class StreamSums:
    """Sums over rows at a point, per channel, as views of one flat tensor.

    Attributes:
        rows: number of rows, a scalar.
        residual: sum of the weighted residuals, which identifies the rows, (m,).
        energy, first, second: sums of the energy and of the terms of its first and second derivative by κ, (m,).
        qw, q2w: sums of w z²/2 and w z⁴/4, (m,).
        score: sum of w r x, (m, n).
        cubed: sum of w r³ x, (m, n); 0 without curvature.
        gram: sum of w (1 - κ z²) x xᵀ, (m, n, n); 0 without curvature.
    """

    rows: Tensor
    residual: Tensor
    energy: Tensor
    first: Tensor
    second: Tensor
    qw: Tensor
    q2w: Tensor
    score: Tensor
    cubed: Tensor
    gram: Tensor

    @staticmethod
    def length(shape: Shape) -> int:
        return 1 + shape.m * (6 + 2 * shape.n + shape.n**2)

    @staticmethod
    def of(flat: Float64[Tensor, " k"], shape: Shape) -> StreamSums:
        m, n = shape.m, shape.n
        rows, channels, score, cubed, gram = flat.split([1, 6 * m, m * n, m * n, m * n * n])
        residual, energy, first, second, qw, q2w = channels.view(6, m).unbind()
        return StreamSums(
            rows=rows[0],
            residual=residual,
            energy=energy,
            first=first,
            second=second,
            qw=qw,
            q2w=q2w,
            score=score.view(m, n),
            cubed=cubed.view(m, n),
            gram=gram.view(m, n, n),
        )


def slopes_pass(batches: Iterable[Any], shape: Shape, point: StreamPoint, *, curvature: bool) -> Float64[Tensor, " k"]:
    """The sums of :class:`StreamSums` over this rank's rows, flat.

    Args:
        batches: batches of this rank.
        shape: shape of every batch.
        point: point of the pass.
        curvature: compute the sums of the Hessian too, which takes two to three times as long.
    """
    adding = _GrowingSums(shape, point, curvature=curvature)
    for block in _in_basis(batches, shape, point):
        adding.add(block)
    return torch.from_numpy(adding.flat)


class _GrowingSums:
    """Accumulates the sums of a pass in memory that all blocks share.

    Allocation for every operation would take as long as the operations."""

    def __init__(self, shape: Shape, point: StreamPoint, *, curvature: bool, report: bool = False) -> None:
        self.flat = np.zeros(StreamSums.length(shape))
        self.meat, self.light, self._report = np.zeros((shape.n, shape.n)), 0, report
        into = StreamSums.of(torch.from_numpy(self.flat), shape)
        self._channels = self.flat[1 : 1 + 6 * shape.m].reshape(6, shape.m)
        self._score, self._cubed, self._gram = (view.numpy() for view in (into.score, into.cubed, into.gram))
        self._point, self._curvature = point, curvature
        self._space = np.empty((5 + 2 * shape.n, 0))

    def add(self, block: StreamBlock) -> None:
        m, n, count = block.X.shape
        if count > self._space.shape[1]:
            self._space = np.empty((5 + 2 * n, count))
        self.flat[0] += count
        for c in range(m):
            self._add_channel(c, block.X[c], block.Y[c], None if block.weight is None else block.weight[c])
        if self._report:
            score = self._space[-n:, :count]
            self.meat += np.matmul(score, score.T)

    def _add_channel(
        self,
        c: int,
        x: Float64[np.ndarray, "n B"],
        y: Float64[np.ndarray, " B"],
        weight: Float64[np.ndarray, " B"] | None,
    ) -> None:
        kappa, inverse = float(self._point.kappa[c]), float(self._point.d[c]) ** -2
        space = self._space[:, : len(y)]
        r, r2, w, s, s3 = space[:5]
        np.matmul(self._point.coef, x, out=r)
        np.subtract(y, r, out=r)
        np.multiply(r, r, out=r2)
        if kappa >= LEAST_KAPPA:
            energy = _few_terms(r2, weight, kappa, inverse, w)
            first = second = math.nan
        else:
            energy, first, second = _all_terms(r, weight, kappa, inverse, w)
        np.multiply(w, r, out=s)
        qw, q2w = 0.5 * inverse * float(np.dot(s, r)), 0.0
        self._score[c] += np.matmul(x, s)
        if self._curvature:
            np.multiply(s, r2, out=s3)
            q2w = 0.25 * inverse**2 * float(np.dot(s3, r))
            self._cubed[c] += np.matmul(x, s3)
            products = space[5 : 5 + len(x)]
            if self._report:
                self._add_score(c, np.multiply(x, s * inverse, out=products), r2)
            # the weight of the curvature replaces r²
            r2 *= -kappa * inverse
            r2 += 1.0
            r2 *= w
            self._gram[c] += np.matmul(np.multiply(x, r2, out=products), x.T)
        if kappa >= LEAST_KAPPA:
            first = (energy - qw) / kappa
            second = (2.0 * first - q2w) / kappa
        residual = float(r.sum()) if weight is None else float(np.dot(weight, r))
        self._channels[:, c] += (residual, energy, first, second, qw, q2w)

    def _add_score(self, c: int, score: Float64[np.ndarray, "n B"], r2: Float64[np.ndarray, " B"]) -> None:
        """Accumulate each row's score over its channels, for the sum of its outer products."""
        whole = self._space[-len(score) :, : score.shape[1]]
        np.copyto(whole, score) if c == 0 else np.add(whole, score, out=whole)
        exponent = 0.5 * float(self._point.kappa[c] / self._point.d[c] ** 2)
        self.light += int(np.count_nonzero(r2 > -math.log(LIGHT) / exponent)) if exponent > 0.0 else 0


def _few_terms(
    r2: Float64[np.ndarray, " B"],
    weight: Float64[np.ndarray, " B"] | None,
    kappa: float,
    inverse: float,
    w: Float64[np.ndarray, " B"],
) -> float:
    """Sum of the energy; writes the weight times the sample weight to ``w``."""
    np.multiply(r2, -0.5 * kappa * inverse, out=w)
    np.exp(w, out=w)
    if weight is not None:
        w *= weight
    total = len(w) if weight is None else float(weight.sum())
    return (total - float(w.sum())) / kappa


def _all_terms(
    r: Float64[np.ndarray, " B"],
    weight: Float64[np.ndarray, " B"] | None,
    kappa: float,
    inverse: float,
    w: Float64[np.ndarray, " B"],
) -> tuple[float, float, float]:
    """Sums of the energy and of its first and second derivative by κ; writes the weights to ``w`` as above."""
    own = np.ones_like(w) if weight is None else weight
    if kappa > 0.0:
        error, share = (torch.from_numpy(np.ascontiguousarray(array)).unsqueeze(-1) for array in (r, own))
        at = (torch.tensor([number], dtype=torch.float64) for number in (kappa, -0.5 * math.log(inverse)))
        found = energy_derivatives(error, share, *at)
        np.exp(np.multiply(r * r, -0.5 * kappa * inverse, out=w), out=w)
        w *= own
        return float(found.value), -float(found.kappa), float(found.kappa_kappa)
    # limited, since its cube would overflow
    q = np.minimum(np.multiply(r * r, 0.5 * inverse, out=w), 1e100, out=w)
    own_q = own * q
    energy, first = float(own_q.sum()), 0.5 * float(np.dot(own_q, q))
    own_q *= q
    second = float(np.dot(own_q, q)) / 3.0
    w[:] = own
    return energy, first, second


def _in_basis(batches: Iterable[Any], shape: Shape, point: StreamPoint) -> Iterator[StreamBlock]:
    """The blocks of a pass, in the basis of ``point``, if any."""
    for _, block in blocks(batches, shape):
        if point.to_basis is not None:
            block = replace(block, joined=np.concatenate([np.matmul(point.to_basis.T, block.X), block.Y[:, None]], 1))
        yield block


@dataclass(frozen=True)
class Extremes:
    """Residuals of the rows in use, of one rank or of all.

    Attributes:
        rows: number of rows.
        residual: sum of the weighted residuals, (m,).
        high, low: largest and smallest residual of positive weight, (m,).
    """

    rows: int
    residual: Float64[np.ndarray, " m"]
    high: Float64[np.ndarray, " m"]
    low: Float64[np.ndarray, " m"]

    def with_others(self, other: Extremes) -> Extremes:
        return Extremes(
            self.rows + other.rows,
            self.residual + other.residual,
            np.maximum(self.high, other.high),
            np.minimum(self.low, other.low),
        )


def range_pass(batches: Iterable[Any], shape: Shape, point: StreamPoint) -> Extremes:
    """Extremes of this rank's residuals; ``kappa`` and ``d`` of the point are not used."""
    nothing = np.full(shape.m, np.inf)
    found = Extremes(0, np.zeros(shape.m), -nothing, nothing)
    for block in _in_basis(batches, shape, point):
        residual = block.Y - np.matmul(point.coef, block.X)
        used: Any = True if block.weight is None else block.weight > 0
        weighted = residual if block.weight is None else residual * block.weight
        high, low = residual.max(1, initial=-np.inf, where=used), residual.min(1, initial=np.inf, where=used)
        found = found.with_others(Extremes(residual.shape[1], weighted.sum(1), high, low))
    return found


@dataclass(frozen=True)
class Report:
    """Sums of the last pass, made at the solution.

    Attributes:
        slopes: sums as in every pass, with curvature.
        meat: sum of the outer products of the rows' scores, each summed over its channels, (n, n).
        light: number of values with a weight below 0.1, a scalar.
    """

    slopes: StreamSums
    meat: Tensor
    light: Tensor

    @staticmethod
    def length(shape: Shape) -> int:
        return StreamSums.length(shape) + shape.n**2 + 1

    @staticmethod
    def of(flat: Float64[Tensor, " k"], shape: Shape) -> Report:
        slopes, meat, light = flat.split([StreamSums.length(shape), shape.n**2, 1])
        return Report(StreamSums.of(slopes, shape), meat.view(shape.n, shape.n), light[0])


def report_pass(batches: Iterable[Any], shape: Shape, point: StreamPoint) -> Float64[Tensor, " k"]:
    """The sums of :class:`Report` over this rank's rows, flat."""
    adding = _GrowingSums(shape, point, curvature=True, report=True)
    for block in _in_basis(batches, shape, point):
        adding.add(block)
    return torch.from_numpy(np.concatenate([adding.flat, adding.meat.reshape(-1), [adding.light]]))
