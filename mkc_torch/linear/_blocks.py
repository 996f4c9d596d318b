"""Sums over the rows of a regression that the MKC likelihood needs, computed in one pass, a block of rows at a time.

A block stays in the processor's cache while its residual, weights and sums are computed, so a pass reads the data once.
Blocks and sums are float64 whatever the dtype of the data. The sums of blocks add up to those of all rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mkc_torch.density.likelihood import Derivatives, energy_terms

if TYPE_CHECKING:
    from jaxtyping import Float, Float64

VALUES = 1 << 15
"""Values in a block: 2.4 MB with nine columns. Half as many take 20 % longer, twice as many 40 %."""

_STRIP = 1 << 12
"""Rows whose products are formed at once; 16384 rows take twice as long."""

_PLAIN_KAPPA = 1e-2
"""κ from which differences of sums over κ and κ² lose at most four digits, so that three sums give all derivatives."""


class Block(NamedTuple):
    """Some rows of a problem, in float64."""

    rows: Float64[Tensor, "b m n"]
    y: Float64[Tensor, "b m"]
    weight: Float64[Tensor, "b m"] | None


class Density(NamedTuple):
    """κ = 1/σ² and d of each channel."""

    kappa: Float64[Tensor, " m"]
    d: Float64[Tensor, " m"]


class Sums(NamedTuple):
    """Sums over the rows for a step in the coefficients, κ and log d.

    :func:`energy_of` computes the energy and its derivatives from ``terms``. ``score`` is the sum of ``w e x``, where w
    is the weight.
    """

    weight: Float64[Tensor, " m"]
    terms: Float64[Tensor, "k m"]
    score: Float64[Tensor, "m n"]

    def plus(self, other: Sums) -> Sums:
        return Sums(*(a + b for a, b in zip(self, other, strict=True)))


class CurvatureSums(NamedTuple):
    """Sums that change little from step to step: the curvature by the coefficients, and sums needed only once.

    ``curvature`` is the Hessian of the summed energy, ``spread`` the products of each sample's score,
    ``tilt`` the sum of ``q w e x`` with ``q = e² / (2 d²)``, ``moment`` that of ``e x`` and ``square`` that of ``e²``.
    """

    curvature: Float64[Tensor, "n n"]
    spread: Float64[Tensor, "n n"]
    tilt: Float64[Tensor, "m n"]
    moment: Float64[Tensor, "m n"]
    square: Float64[Tensor, " m"]

    def plus(self, other: CurvatureSums) -> CurvatureSums:
        return CurvatureSums(*(a + b for a, b in zip(self, other, strict=True)))


class ResidualRange(NamedTuple):
    """Smallest and largest residual of each channel over the samples in use."""

    low: Float64[Tensor, " m"]
    high: Float64[Tensor, " m"]

    def plus(self, other: ResidualRange) -> ResidualRange:
        return ResidualRange(torch.minimum(self.low, other.low), torch.maximum(self.high, other.high))


def blocks(
    X: Float[Tensor, "N m n"],
    Y: Float[Tensor, "N m"],
    weight: Float[Tensor, "N m"] | None,
    frame: Float64[Tensor, "n n"] | None = None,
    values: int = VALUES,
) -> Iterator[Block]:
    """Yield rows times ``frame``, targets and weights in blocks of ``values`` values."""
    step = max(1, values // Y.shape[-1])
    for first in range(0, Y.shape[0], step):
        part = slice(first, first + step)
        rows = X[part].double()
        yield Block(
            rows if frame is None else torch.matmul(rows, frame),
            Y[part].double(),
            None if weight is None else weight[part].double(),
        )


def residual(block: Block, coef: Float64[Tensor, " n"]) -> Float64[Tensor, "b m"]:
    if block.rows.shape[1] == 1:
        return torch.addmv(block.y[:, 0], block.rows[:, 0], coef, alpha=-1.0).unsqueeze(-1)
    return block.y - torch.matmul(block.rows, coef)


def residual_range(block: Block, coef: Float64[Tensor, " n"]) -> ResidualRange:
    error = residual(block, coef)
    if block.weight is None:
        return ResidualRange(*torch.aminmax(error, dim=0))
    used = block.weight > 0
    return ResidualRange(torch.where(used, error, torch.inf).amin(0), torch.where(used, error, -torch.inf).amax(0))


def kernel(error: Float64[Tensor, "b m"], density: Density) -> tuple[Float64[Tensor, "b m"], Float64[Tensor, "b m"]]:
    """Return ``q = e² / (2 d²)`` and the weight ``exp(-κ q)``."""
    q = error.square() * (0.5 / density.d.square())
    return q, torch.exp(q * -density.kappa)


def _moments(values: Float64[Tensor, "b m"], block: Block) -> Float64[Tensor, "m n"]:
    """Sum over the rows of each channel's values times x."""
    if block.rows.shape[1] == 1:
        return torch.mv(block.rows[:, 0].mT, values[:, 0]).unsqueeze(0)
    return torch.matmul(values.mT.unsqueeze(1), block.rows.transpose(0, 1)).squeeze(1)


def sums(block: Block, error: Tensor, q: Tensor, w: Tensor, density: Density) -> Sums:
    """The sums of a block, from its residual and the results of :func:`kernel`."""
    weighted = w if block.weight is None else w * block.weight
    weight = error.new_full((error.shape[1],), float(error.shape[0])) if block.weight is None else block.weight.sum(0)
    if _plain(density.kappa):
        qw = q * weighted
        terms = torch.stack([weighted.sum(0), qw.sum(0), qw.mul_(q).sum(0)])
    else:
        w, value, first, second = energy_terms(q, density.kappa)
        every = torch.stack([value, first, second, q * w, q * q * w])
        terms = every.sum(1) if block.weight is None else (every * block.weight).sum(1)
    return Sums(weight, terms, _moments(weighted * error, block))


def _plain(kappa: Float64[Tensor, " m"]) -> bool:
    return bool((kappa >= _PLAIN_KAPPA).all())


def energy_of(total: Sums, kappa: Float64[Tensor, " m"]) -> Derivatives:
    """The summed energy and its derivatives by κ and log d."""
    if _plain(kappa):
        w, qw, q2w = total.terms
        value = (total.weight - w) / kappa
        first = (value - qw) / kappa
        second = (2.0 * first - q2w) / kappa
    else:
        value, first, second, qw, q2w = total.terms
    return Derivatives(value, -first, -2.0 * qw, second, 2.0 * q2w, 4.0 * (qw - kappa * q2w))


def _products(
    rows: Float64[Tensor, "k n"], others: Float64[Tensor, "k n"], weight: Float64[Tensor, " k"]
) -> Float64[Tensor, "n n"]:
    """Sum of weight · rowᵀ · other row, by NumPy, which takes half as long as torch where MKL is slow."""
    total = np.zeros((rows.shape[1], others.shape[1]))
    for first in range(0, rows.shape[0], _STRIP):
        part = slice(first, first + _STRIP)
        total += (rows[part] * weight[part].unsqueeze(-1)).numpy().T @ others[part].numpy()
    return torch.from_numpy(total)


def curvature_sums(block: Block, error: Tensor, q: Tensor, w: Tensor, density: Density) -> CurvatureSums:
    """The curvature sums of a block, from its residual and the results of :func:`kernel`."""
    weighted, plain = (w, error) if block.weight is None else (w * block.weight, error * block.weight)
    precision = density.d.pow(-2)
    curvature_weight = weighted * (1.0 - 2.0 * density.kappa * q) * precision
    score = weighted * error * precision
    flat = block.rows.flatten(0, 1)
    if block.rows.shape[1] == 1:
        spread = _products(flat, flat, score.square().flatten())
    else:
        scored = torch.matmul(score.unsqueeze(1), block.rows).squeeze(1)
        spread = torch.matmul(scored.mT, scored)
    return CurvatureSums(
        curvature=_products(flat, flat, curvature_weight.flatten()),
        spread=spread,
        tilt=_moments(q * weighted * error, block),
        moment=_moments(plain, block),
        square=(plain * error).sum(0),
    )


def triangle(block: Block, above: Float64[Tensor, "k n"] | None) -> Float64[Tensor, "k n"]:
    """Upper triangle R of X = QR, for the rows of a block in use and the rows whose triangle is ``above``."""
    rows = block.rows if block.weight is None else block.rows * (block.weight > 0).unsqueeze(-1)
    flat = rows.flatten(0, 1)
    return torch.linalg.qr(flat if above is None else torch.cat([above, flat]), mode="r").R
