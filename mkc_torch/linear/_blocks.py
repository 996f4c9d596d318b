"""Sums over the rows of a regression that the MKC likelihood needs, of a block of rows in float64.

The sums of blocks add up to those of all rows.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from mkc_torch.density.energy import energy_terms
from mkc_torch.density.likelihood import Derivatives
from mkc_torch.linear.summary import LIGHT

if TYPE_CHECKING:
    from jaxtyping import Float64

_STRIP = 1 << 12
"""Rows whose products are formed at once; 16384 rows take twice as long."""

PLAIN_KAPPA = 1e-2
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
    """Least and largest residual of each channel over the samples in use."""

    low: Float64[Tensor, " m"]
    high: Float64[Tensor, " m"]

    def with_others(self, other: ResidualRange) -> ResidualRange:
        return ResidualRange(torch.minimum(self.low, other.low), torch.maximum(self.high, other.high))

    def half(self) -> Float64[Tensor, " m"]:
        """Half the range."""
        return 0.5 * (self.high - self.low)


class PassResult(NamedTuple):
    """Sums of a pass over rows, and the curvature sums and the range of the residuals if they were wanted."""

    total: Sums
    curvature: CurvatureSums | None
    extent: ResidualRange | None


Added = TypeVar("Added", Sums, CurvatureSums)


def added(total: Added | None, part: Added) -> Added:
    """The sums of two sets of rows; None is no rows."""
    return part if total is None else type(part)(*(a + b for a, b in zip(total, part, strict=True)))


def residual(block: Block, coef: Float64[Tensor, " n"]) -> Float64[Tensor, "b m"]:
    if block.rows.shape[1] == 1:
        return torch.addmv(block.y[:, 0], block.rows[:, 0], coef, alpha=-1.0).unsqueeze(-1)
    return block.y - torch.matmul(block.rows, coef)


def residual_range(block: Block, error: Float64[Tensor, "b m"]) -> ResidualRange:
    if block.weight is None:
        return ResidualRange(*torch.aminmax(error, dim=0))
    used = block.weight > 0
    return ResidualRange(
        torch.where(used, error, torch.inf).amin(0),
        torch.where(used, error, -torch.inf).amax(0),
    )


def kernel(error: Float64[Tensor, "b m"], density: Density) -> tuple[Float64[Tensor, "b m"], Float64[Tensor, "b m"]]:
    """Return ``q = e² / (2 d²)`` and the weight ``exp(-κ q)``."""
    q = error.square() * (0.5 / density.d.square())
    return q, torch.exp(q * -density.kappa)


def _moments(values: Float64[Tensor, "b m"], block: Block) -> Float64[Tensor, "m n"]:
    """Sum over the rows of each channel's values times x."""
    if block.rows.shape[1] == 1:
        return torch.mv(block.rows[:, 0].mT, values[:, 0]).unsqueeze(0)
    return torch.matmul(values.mT.unsqueeze(1), block.rows.transpose(0, 1)).squeeze(1)


def sums(block: Block, error: Tensor, q: Tensor, w: Tensor, density: Density, *, plain: bool) -> Sums:
    """The sums of a block, from its residual and the results of :func:`kernel`.

    Args:
        block, error, q, w: the block, its residuals, and the results of :func:`kernel`.
        density: κ and d.
        plain: whether κ is at least :data:`PLAIN_KAPPA` in every channel.
    """
    weighted = w if block.weight is None else w * block.weight
    weight = error.new_full((error.shape[1],), float(error.shape[0])) if block.weight is None else block.weight.sum(0)
    score = weighted * error
    if plain:
        qw = q * weighted
        terms = energy_sums(weight, weighted.sum(0), qw.sum(0), qw.mul_(q).sum(0), density.kappa)
    else:
        # limited, since the cube of q would overflow
        q = q.clamp(max=1e100)
        w, value, first, second = energy_terms(q, density.kappa)
        every = torch.stack([value, first, second, q * w, q * q * w])
        terms = every.sum(1) if block.weight is None else (every * block.weight).sum(1)
    total = error.sum(0) if block.weight is None else (error * block.weight).sum(0)
    return Sums(weight, total, terms, _moments(score, block))


def energy_sums(weight: Tensor, w: Tensor, qw: Tensor, q2w: Tensor, kappa: Tensor) -> Float64[Tensor, "5 m"]:
    """The terms of :class:`Sums` from the sums of the weights, of w, q w and q² w, for a κ that is not small."""
    value = (weight - w) / kappa
    first = (value - qw) / kappa
    return torch.stack([value, first, (2.0 * first - q2w) / kappa, qw, q2w])


def is_plain(kappa: Float64[Tensor, " m"]) -> bool:
    return bool((kappa >= PLAIN_KAPPA).all())


def energy_of(total: Sums, kappa: Float64[Tensor, " m"]) -> Derivatives:
    """The summed energy and its derivatives by κ and log d."""
    value, first, second, qw, q2w = total.terms
    return Derivatives(value, -first, -2.0 * qw, second, 2.0 * q2w, 4.0 * (qw - kappa * q2w))


def products(
    rows: Float64[Tensor, "k n"], others: Float64[Tensor, "k j"], weight: Float64[Tensor, " k"] | None = None
) -> Float64[Tensor, "n j"]:
    """Sum of weight · rowᵀ · other row; on a CPU by NumPy, which takes half as long as torch where MKL is slow."""
    if rows.device.type != "cpu":
        return torch.matmul((rows if weight is None else rows * weight.unsqueeze(-1)).mT, others)
    total = np.zeros((rows.shape[1], others.shape[1]))
    for first in range(0, rows.shape[0], _STRIP):
        part = slice(first, first + _STRIP)
        strip = rows[part] if weight is None else rows[part] * weight[part].unsqueeze(-1)
        total += strip.numpy().T @ others[part].numpy()
    return torch.from_numpy(total)


def curvature_sums(block: Block, error: Tensor, q: Tensor, w: Tensor, density: Density) -> CurvatureSums:
    """The curvature sums of a block, from its residual and the results of :func:`kernel`."""
    weighted, plain = (w, error) if block.weight is None else (w * block.weight, error * block.weight)
    precision = density.d.pow(-2)
    curvature_weight = weighted * (1.0 - 2.0 * density.kappa * q) * precision
    score = weighted * error * precision
    flat = block.rows.flatten(0, 1)
    if block.rows.shape[1] == 1:
        spread = products(flat, flat, score.square().flatten())
    else:
        scored = torch.matmul(score.unsqueeze(1), block.rows).squeeze(1)
        spread = torch.matmul(scored.mT, scored)
    return CurvatureSums(
        curvature=products(flat, flat, curvature_weight.flatten()),
        spread=spread,
        tilt=_moments(q * weighted * error, block),
        moment=_moments(plain, block),
        square=(plain * error).sum(0),
        light=(w < LIGHT).sum().double().reshape(1),
    )


def triangle(block: Block, above: Float64[Tensor, "k n"] | None) -> Float64[Tensor, "k n"]:
    """Upper triangle R of X = QR, for the rows of a block in use and the rows whose triangle is ``above``."""
    rows = block.rows if block.weight is None else block.rows * (block.weight > 0).unsqueeze(-1)
    flat = rows.flatten(0, 1)
    return torch.linalg.qr(flat if above is None else torch.cat([above, flat]), mode="r").R
