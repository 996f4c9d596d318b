"""Sums over rows that the likelihood, its gradient and its Hessian are made of: what one pass works out.

With ``w = exp(-κ z² / 2)`` the energy is ``(1 - w) / κ``, and each of its derivatives by κ and log d is a combination
of the sums of 1, w, w r² and w r⁴. So a pass has a handful of operations on each residual r and one on each row.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from mkc_torch.density.fit import _energy_terms
from mkc_torch.linear.streaming._blocks import Block, Shape, blocks

if TYPE_CHECKING:
    from jaxtyping import Float64
    from torch import Tensor

__all__ = ["LIGHT", "Point", "Report", "Slopes", "range_pass", "report_pass", "slopes_pass"]

LEAST_KAPPA = 1e-3
"""1/σ² below which the derivatives by it are taken term by term: as differences of sums they would lose more than six
of sixteen digits."""

LIGHT = 0.1
"""A weight below it counts as that of a value that is all but left out, as in a summary."""


@dataclass(frozen=True)
class Point:
    """Where a pass is made: coefficients, κ = 1/σ² and d of each channel.

    ``to_basis`` turns the columns, block by block, where they are so nearly dependent that sums of their products
    would be of no use; the coefficients then are those of the columns it makes.
    """

    coef: Float64[np.ndarray, " n"]
    kappa: Float64[np.ndarray, " m"]
    d: Float64[np.ndarray, " m"]
    to_basis: Float64[np.ndarray, "n n"] | None = None


@dataclass(frozen=True)
class Slopes:
    """Sums over rows at a point, of each channel, as views of one flat tensor.

    Attributes:
        rows: their number, a scalar.
        residual: of the residuals, by which the rows are known again, (m,).
        energy, first, second: of the energy and of what its first and second derivatives by κ are, (m,).
        qw, q2w: of w z²/2 and w z⁴/4, (m,).
        score: of w r x, (m, n).
        cubed: of w r³ x, (m, n); 0 unless the curvature is worked out.
        gram: of w (1 - κ z²) x xᵀ, (m, n, n); 0 unless the curvature is worked out.
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
    def of(flat: Float64[Tensor, " k"], shape: Shape) -> Slopes:
        m, n = shape.m, shape.n
        rows, channels, score, cubed, gram = flat.split([1, 6 * m, m * n, m * n, m * n * n])
        residual, energy, first, second, qw, q2w = channels.view(6, m).unbind()
        return Slopes(
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


def slopes_pass(batches: Iterable[Any], shape: Shape, point: Point, *, curvature: bool) -> Float64[Tensor, " k"]:
    """The sums of :class:`Slopes` over this rank's rows, flat.

    Args:
        batches: of this rank.
        shape: of every batch.
        point: where.
        curvature: work out also what the Hessian is made of, which takes two to three times as long.
    """
    flat = torch.zeros(Slopes.length(shape), dtype=torch.float64)
    into = Slopes.of(flat, shape)
    for block in _in_basis(batches, shape, point):
        into.rows.add_(len(block.X))
        for c in range(shape.m):
            weight = None if block.weight is None else block.weight[:, c]
            _add(into, c, block.X[:, c], block.Y[:, c], weight, point, curvature)
    return flat


def _add(
    into: Slopes,
    c: int,
    x: Float64[np.ndarray, "B n"],
    y: Float64[np.ndarray, " B"],
    weight: Float64[np.ndarray, " B"] | None,
    point: Point,
    curvature: bool,
) -> None:
    kappa, inverse = float(point.kappa[c]), float(point.d[c]) ** -2
    r = y - x @ point.coef
    r2 = r * r
    into.residual[c] += float(r.sum())
    w, energy, first, second = (_few_terms if kappa >= LEAST_KAPPA else _all_terms)(r2, weight, kappa, inverse)
    s = w * r
    qw, q2w = 0.5 * inverse * float(s @ r), 0.0
    into.score[c] += torch.from_numpy(s @ x)
    if curvature:
        s3 = s * r2
        q2w = 0.25 * inverse**2 * float(s3 @ r)
        into.cubed[c] += torch.from_numpy(s3 @ x)
        into.gram[c] += torch.from_numpy(_gram(x, w * (1.0 - kappa * inverse * r2)))
    if first is None or second is None:
        first = (energy - qw) / kappa
        second = (2.0 * first - q2w) / kappa
    for field, value in ((into.energy, energy), (into.first, first), (into.second, second), (into.qw, qw)):
        field[c] += value
    into.q2w[c] += q2w


def _few_terms(
    r2: Float64[np.ndarray, " B"], weight: Float64[np.ndarray, " B"] | None, kappa: float, inverse: float
) -> tuple[Float64[np.ndarray, " B"], float, None, None]:
    """Weight times w, and the sum of the energy."""
    w = np.multiply(r2, -0.5 * kappa * inverse)
    np.exp(w, out=w)
    if weight is not None:
        w *= weight
    total = len(w) if weight is None else float(weight.sum())
    return w, (total - float(w.sum())) / kappa, None, None


def _all_terms(
    r2: Float64[np.ndarray, " B"], weight: Float64[np.ndarray, " B"] | None, kappa: float, inverse: float
) -> tuple[Float64[np.ndarray, " B"], float, float, float]:
    """Weight times w, and the sums of the energy and of its first and second derivative by κ."""
    # capped where its cube overflows
    q = torch.from_numpy(np.minimum(0.5 * inverse * r2, 1e100))
    if kappa > 0.0:
        w, *terms = _energy_terms(q, torch.tensor(kappa, dtype=torch.float64))
    else:
        w, *terms = torch.ones_like(q), q, 0.5 * q * q, q * q * q / 3.0
    own = torch.ones_like(q) if weight is None else torch.from_numpy(weight).contiguous()
    energy, first, second = (float(own @ term) for term in terms)
    return (own * w).numpy(), energy, first, second


def _gram(x: Float64[np.ndarray, "B n"], weight: Float64[np.ndarray, " B"]) -> Float64[np.ndarray, "n n"]:
    # rows of the transpose are long, and numpy is slow where they are short
    turned = np.ascontiguousarray(x.T)
    turned *= weight
    return turned @ x


def _in_basis(batches: Iterable[Any], shape: Shape, point: Point) -> Iterator[Block]:
    """The blocks of a pass, their columns turned where the point says so."""
    for _, block in blocks(batches, shape):
        yield block if point.to_basis is None else replace(block, X=block.X @ point.to_basis)


def range_pass(batches: Iterable[Any], shape: Shape, point: Point) -> Float64[Tensor, " k"]:
    """The largest residuals and the largest of their negatives over this rank's rows of positive weight, (2 m,).

    ``kappa`` and ``d`` of the point are of no use here.
    """
    found = np.full((2, shape.m), -np.inf)
    for block in _in_basis(batches, shape, point):
        residual = block.Y - block.X @ point.coef
        used = True if block.weight is None else block.weight > 0
        for sign, into in ((1.0, found[0]), (-1.0, found[1])):
            np.maximum(into, (sign * residual).max(0, initial=-np.inf, where=used), out=into)
    return torch.from_numpy(found.reshape(-1))


@dataclass(frozen=True)
class Report:
    """Sums of the last pass, made at the solution.

    Attributes:
        slopes: as in every pass, with the curvature.
        meat: of the products of each row's score with itself, summed over its channels, (n, n).
        light: values of a weight below 0.1, a scalar.
    """

    slopes: Slopes
    meat: Tensor
    light: Tensor

    @staticmethod
    def length(shape: Shape) -> int:
        return Slopes.length(shape) + shape.n**2 + 1

    @staticmethod
    def of(flat: Float64[Tensor, " k"], shape: Shape) -> Report:
        slopes, meat, light = flat.split([Slopes.length(shape), shape.n**2, 1])
        return Report(Slopes.of(slopes, shape), meat.view(shape.n, shape.n), light[0])


def report_pass(batches: Iterable[Any], shape: Shape, point: Point) -> Float64[Tensor, " k"]:
    """The sums of :class:`Report` over this rank's rows, flat."""
    flat = torch.zeros(Report.length(shape), dtype=torch.float64)
    into = Report.of(flat, shape)
    for block in _in_basis(batches, shape, point):
        into.slopes.rows.add_(len(block.X))
        score = np.zeros((len(block.X), shape.n))
        for c in range(shape.m):
            weight = None if block.weight is None else block.weight[:, c]
            x, y = block.X[:, c], block.Y[:, c]
            _add(into.slopes, c, x, y, weight, point, curvature=True)
            r = y - x @ point.coef
            w = np.exp(-0.5 * point.kappa[c] * (r / point.d[c]) ** 2)
            into.light.add_(int((w < LIGHT).sum()))
            psi = w * r * float(point.d[c]) ** -2
            score += x * (psi if weight is None else psi * weight)[:, None]
        into.meat.add_(torch.from_numpy(score.T @ score))
    return flat
