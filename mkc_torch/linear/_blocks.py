"""What one pass over the rows of a regression adds up for the MKC likelihood, a block of rows at a time.

A block stays in a processor's cache while its residual, weights and sums are made, so that a pass reads the data once.
Whatever the dtype of the data, blocks and sums are float64. Sums of blocks add up to those of all rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch.density.fit import Derivatives, energy_terms

if TYPE_CHECKING:
    from jaxtyping import Float, Float64

VALUES = 1 << 14
"""Values in a block: 1.2 MB of nine columns. Between 4096 and 32768 the time of a pass differs by less than noise."""

_PLAIN_KAPPA = 1e-2
"""From here on differences of sums over κ and κ² lose at most four digits, so that three sums give every derivative."""


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
    """What a step in the coefficients, κ and log d needs of the rows.

    ``energy`` is that of the density's head and its derivatives, in the order of :class:`Derivatives`; ``score`` the
    sums of ``w e x``, ``q w e x`` and ``e x`` with ``q = e² / (2 d²)`` and w the kernel's weight.
    """

    weight: Float64[Tensor, " m"]
    square: Float64[Tensor, " m"]
    energy: Float64[Tensor, "6 m"]
    score: Float64[Tensor, "3 m n"]

    def plus(self, other: Sums) -> Sums:
        return Sums(*(a + b for a, b in zip(self, other, strict=True)))


class Matrices(NamedTuple):
    """Curvature of the summed energy by the coefficients, and the products of each sample's score with itself."""

    curvature: Float64[Tensor, "n n"]
    spread: Float64[Tensor, "n n"]

    def plus(self, other: Matrices) -> Matrices:
        return Matrices(*(a + b for a, b in zip(self, other, strict=True)))


class Range(NamedTuple):
    """Least and largest residual of each channel among the samples in use."""

    low: Float64[Tensor, " m"]
    high: Float64[Tensor, " m"]

    def plus(self, other: Range) -> Range:
        return Range(torch.minimum(self.low, other.low), torch.maximum(self.high, other.high))


def blocks(
    X: Float[Tensor, "N m n"],
    Y: Float[Tensor, "N m"],
    weight: Float[Tensor, "N m"] | None,
    frame: Float64[Tensor, "n n"] | None = None,
    values: int = VALUES,
) -> Iterator[Block]:
    """Rows times ``frame``, targets and weights in blocks of so many values."""
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
    return block.y - torch.matmul(block.rows, coef)


def residual_range(block: Block, coef: Float64[Tensor, " n"]) -> Range:
    error = residual(block, coef)
    if block.weight is None:
        return Range(*torch.aminmax(error, dim=0))
    used = block.weight > 0
    return Range(torch.where(used, error, torch.inf).amin(0), torch.where(used, error, -torch.inf).amax(0))


def kernel(error: Float64[Tensor, "b m"], density: Density) -> tuple[Float64[Tensor, "b m"], Float64[Tensor, "b m"]]:
    """q = e² / (2 d²) and the kernel's weight ``exp(-κ q)``."""
    q = error.square() * (0.5 / density.d.square())
    return q, torch.exp(q * -density.kappa)


def sums(block: Block, error: Tensor, q: Tensor, w: Tensor, density: Density) -> Sums:
    """The sums of a block at its residual and :func:`kernel`."""
    weighted = w if block.weight is None else w * block.weight
    plain = error if block.weight is None else error * block.weight
    q_weighted = q * weighted
    scored = torch.stack([weighted * error, q_weighted * error, plain]).permute(2, 0, 1)
    weight = error.new_full((error.shape[1],), float(error.shape[0])) if block.weight is None else block.weight.sum(0)
    if bool((density.kappa >= _PLAIN_KAPPA).all()):
        energy = _energy_of_sums(weight, weighted.sum(0), q_weighted.sum(0), (q * q_weighted).sum(0), density.kappa)
    else:
        energy = _energy(block, q, density.kappa)
    return Sums(
        weight, (plain * error).sum(0), energy, torch.matmul(scored, block.rows.transpose(0, 1)).transpose(0, 1)
    )


def _energy_of_sums(weight: Tensor, w: Tensor, qw: Tensor, q2w: Tensor, kappa: Tensor) -> Float64[Tensor, "6 m"]:
    value = (weight - w) / kappa
    first = (value - qw) / kappa
    return _in_order(value, first, (2.0 * first - q2w) / kappa, qw, q2w, kappa)


def _energy(block: Block, q: Tensor, kappa: Tensor) -> Float64[Tensor, "6 m"]:
    """As :func:`_energy_of_sums`, with every term exact down to κ = 0."""
    w, value, first, second = energy_terms(q, kappa)
    every = torch.stack([value, first, second, q * w, q * q * w])
    total = every.sum(1) if block.weight is None else (every * block.weight).sum(1)
    return _in_order(*total.unbind(), kappa)


def _in_order(
    value: Tensor, first: Tensor, second: Tensor, qw: Tensor, q2w: Tensor, kappa: Tensor
) -> Float64[Tensor, "6 m"]:
    return torch.stack(Derivatives(value, -first, -2.0 * qw, second, 2.0 * q2w, 4.0 * (qw - kappa * q2w)))


def matrices(block: Block, error: Tensor, q: Tensor, w: Tensor, density: Density) -> Matrices:
    """Curvature and spread of a block at its residual and :func:`kernel`."""
    weighted = w if block.weight is None else w * block.weight
    precision = density.d.pow(-2)
    bend = weighted * (1.0 - 2.0 * density.kappa * q) * precision
    score = weighted * error * precision
    flat = block.rows.flatten(0, 1)
    single = block.rows.shape[1] == 1
    scored = flat * score if single else torch.matmul(score.unsqueeze(1), block.rows).squeeze(1)
    return Matrices(torch.matmul((flat * bend.reshape(-1, 1)).mT, flat), torch.matmul(scored.mT, scored))
