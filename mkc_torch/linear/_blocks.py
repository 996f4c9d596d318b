"""Sums over rows of a regression for the MKC likelihood, formed for blocks of rows in float64.

The sums of blocks add up to those of all rows.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch.density.likelihood import Derivatives

if TYPE_CHECKING:
    from jaxtyping import Float64


class Block(NamedTuple):
    """Some rows of a problem, in float64; ``joined`` is [rows y] where they lie together in memory."""

    rows: Float64[Tensor, "b m n"]
    y: Float64[Tensor, "b m"]
    weight: Float64[Tensor, "b m"] | None
    joined: Float64[Tensor, "b m k"] | None = None


class Density(NamedTuple):
    """κ = 1/σ² and d of each channel."""

    kappa: Float64[Tensor, " m"]
    d: Float64[Tensor, " m"]


class Sums(NamedTuple):
    """Sums over the rows for a step in the coefficients, κ and log d.

    ``residual`` is the sum of the weighted residuals, which identifies the rows. ``terms`` are the sums of the energy,
    of the terms of its first and second derivative by κ, of q w and of q² w; :func:`energy_of` derives the rest.
    ``score`` is the sum of ``w e x``, where w is the weight.
    """

    weight: Float64[Tensor, " m"]
    residual: Float64[Tensor, " m"]
    terms: Float64[Tensor, "5 m"]
    score: Float64[Tensor, "m n"]


class CurvatureSums(NamedTuple):
    """Sums that change little from step to step: the curvature by the coefficients, and sums needed only once.

    ``curvature`` is the Hessian of the summed energy, ``spread`` the products of each sample's score,
    ``tilt`` the sum of ``q w e x`` with ``q = e² / (2 d²)``, ``moment`` that of ``e x`` and ``square`` that of ``e²``;
    ``light`` counts the values with a weight below :data:`LIGHT`.
    """

    curvature: Float64[Tensor, "n n"]
    spread: Float64[Tensor, "n n"]
    tilt: Float64[Tensor, "m n"]
    moment: Float64[Tensor, "m n"]
    square: Float64[Tensor, " m"]
    light: Float64[Tensor, " 1"]


class ResidualRange(NamedTuple):
    """Smallest and largest residual of each channel over the samples in use."""

    low: Float64[Tensor, " m"]
    high: Float64[Tensor, " m"]

    def half(self) -> Float64[Tensor, " m"]:
        """Half the range."""
        return 0.5 * (self.high - self.low)


class PassResult(NamedTuple):
    """Sums of a pass over rows, and the curvature sums and the range of the residuals if requested."""

    total: Sums
    curvature: CurvatureSums | None
    extent: ResidualRange | None

    def flat(self) -> Float64[Tensor, " k"]:
        """All sums as one vector, which adds up over blocks, batches and ranks."""
        return torch.cat([value.reshape(-1) for value in (*self.total, *(self.curvature or ()))])

    @staticmethod
    def of_flat(flat: Float64[Tensor, " k"], m: int, n: int, extent: ResidualRange | None = None) -> PassResult:
        """The sums of :meth:`flat`, of m channels of n columns."""
        shapes = _shapes(m, n)
        sizes = [torch.Size(shape).numel() for shape in shapes]
        count = len(shapes) if len(flat) == sum(sizes) else len(Sums._fields)
        fields = [part.reshape(shape) for part, shape in zip(flat.split(sizes[:count]), shapes, strict=False)]
        total, more = fields[: len(Sums._fields)], fields[len(Sums._fields) :]
        return PassResult(Sums(*total), CurvatureSums(*more) if more else None, extent)


def _shapes(m: int, n: int) -> list[tuple[int, ...]]:
    """Shapes of the fields of :class:`Sums` and of :class:`CurvatureSums`."""
    return [(m,), (m,), (5, m), (m, n), (n, n), (n, n), (m, n), (m, n), (m,), (1,)]


def flat_length(m: int, n: int, *, with_curvature: bool) -> int:
    """Length of :meth:`PassResult.flat`."""
    shapes = _shapes(m, n)[: None if with_curvature else len(Sums._fields)]
    return sum(torch.Size(shape).numel() for shape in shapes)


def energy_of(total: Sums, kappa: Float64[Tensor, " m"]) -> Derivatives:
    """The summed energy and its derivatives by κ and log d."""
    value, first, second, qw, q2w = total.terms
    return Derivatives(value, -first, -2.0 * qw, second, 2.0 * q2w, 4.0 * (qw - kappa * q2w))


def triangle(block: Block, above: Float64[Tensor, "k n"] | None) -> Float64[Tensor, "k n"]:
    """Upper triangle R of X = QR, for the rows of a block in use and the rows whose triangle is ``above``."""
    rows = block.rows if block.weight is None else block.rows * (block.weight > 0).unsqueeze(-1)
    flat = rows.flatten(0, 1)
    return torch.linalg.qr(flat if above is None else torch.cat([above, flat]), mode="r").R
