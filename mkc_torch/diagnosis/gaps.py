"""Rejected samples: what coloured noise is there to be expected, by what is around it.

A zero in place of a rejected sample is right where noise is white. Where it wanders, zeros cut holes into it, and what
is cut out reaches all frequencies. The expectation of the noise there is linear in the samples that count: done to the
residual and to all tangents alike, it leaves the amplitudes of effects what they are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.noise import Colour, dct

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["Filling", "Gaps"]

_PLAIN = 0.3
"""A spectrum nearer to the level of its end than this share counts as white there."""

_END = 20
"""One in so many frequencies, the highest ones, show the level of the spectrum's end."""

_MOST, _CELLS = 1000, 20_000_000
"""Frequencies at most that are not taken for white, those that are the farthest from it; fewer where their products
with all others would be more numbers than these."""


class Gaps:
    """The rejected samples of each channel.

    Args:
        counts: 0 where a sample is rejected, else 1.
        kept: number K of the slowest cosine coefficients that are looked at.
    """

    def __init__(self, counts: Float[Tensor, "N m"], kept: int) -> None:
        N = len(counts)
        self._N, self._kept = N, kept
        known = dct(1.0 - counts) * math.sqrt(N / 2)
        known[0] *= math.sqrt(2.0)
        # sums of cosines at the rejected samples; beyond the N-th frequency they go back, with the other sign
        self._sums = torch.cat([known, torch.zeros_like(known[:1]), -known[1:].flip(0)])
        self._any = (counts == 0).any(0).tolist()

    def overlap(self, channel: int, rows: Tensor) -> Float[Tensor, "K J"]:
        """Inner products of the basis with its functions of these numbers, over the rejected samples of a channel."""
        k = torch.arange(self._kept).unsqueeze(-1)
        sums = self._sums[:, channel]
        product = (sums[(k - rows).abs()] + sums[k + rows]) / self._N
        product[0] *= math.sqrt(0.5)
        product[:, rows == 0] *= math.sqrt(0.5)
        return product

    def filling(self, colour: Colour) -> Filling:
        """The rejected samples' expectation under noise of this colour."""
        spectrum = colour.root.square()
        K, m = spectrum.shape
        end = spectrum[-max(K // _END, 1) :].mean(0)
        excess = end / spectrum - 1.0
        parts: list[_Part | None] = []
        log_det = 0.0
        for channel in range(m):
            far = excess[:, channel].abs()
            rows = torch.nonzero(far > _PLAIN).flatten()
            if len(rows) == 0 or not self._any[channel]:
                parts.append(None)
                continue
            most = min(_MOST, max(_CELLS // K, 1))
            if len(rows) > most:
                rows = rows[far[rows].topk(most).indices].sort().values
            overlap = self.overlap(channel, rows)
            own = excess[rows, channel]
            system = torch.eye(len(rows), dtype=own.dtype) + own.unsqueeze(-1) * overlap[rows]
            factors, pivots = torch.linalg.lu_factor(system)
            log_det += float(factors.diagonal().abs().log().sum())
            parts.append(_Part(rows, own, overlap, factors, pivots))
        return Filling(tuple(parts), log_det)


@dataclass(frozen=True)
class _Part:
    rows: Tensor
    excess: Tensor
    overlap: Tensor
    factors: Tensor
    pivots: Tensor

    def __call__(self, values: Float[Tensor, "K c"]) -> Float[Tensor, "K c"]:
        pulled = torch.linalg.lu_solve(self.factors, self.pivots, self.excess.unsqueeze(-1) * values[self.rows])
        return values - self.overlap @ pulled


@dataclass(frozen=True)
class Filling:
    """What to add to the slowest cosine coefficients of series that are 0 at rejected samples.

    With P the precision of the noise, 1 at the end of its spectrum, x at the rejected samples m is
    ``-(P_mm)^-1 (P x)_m``; in the basis of cosines, and by the identity of Woodbury, this takes no more than the
    frequencies at which the noise is not white.

    Attributes:
        parts: one a channel; None where nothing is to be done.
        log_det: of ``P_mm``.
    """

    parts: tuple[_Part | None, ...]
    log_det: float

    @property
    def nothing(self) -> bool:
        """Whether all is left as it is."""
        return all(part is None for part in self.parts)

    def __call__(self, coefficients: Float[Tensor, "K m *rest"]) -> Float[Tensor, "K m *rest"]:
        if self.nothing or coefficients.numel() == 0:
            return coefficients
        flat = coefficients.flatten(2) if coefficients.dim() > 2 else coefficients.unsqueeze(-1)
        filled = [
            values if part is None else part(values) for part, values in zip(self.parts, flat.unbind(1), strict=True)
        ]
        return torch.stack(filled, 1).view_as(coefficients)
