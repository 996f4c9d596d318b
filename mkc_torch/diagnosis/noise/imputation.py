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

from mkc_torch.diagnosis.noise.cosine_basis import dct
from mkc_torch.diagnosis.noise.spectrum import NoiseSpectrum

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["Imputation", "MissingSamples"]

_PLAIN = 0.3
"""A spectrum nearer to the level of its end than this share counts as white there."""

_END = 20
"""One in so many frequencies, the highest ones, show the level of the spectrum's end."""

_MOST, _CELLS = 1000, 20_000_000
"""Frequencies at most that are not taken for white, those that are the farthest from it; fewer where their products
with all others would be more numbers than these."""

_HANDY = 0.5
"""Rejected samples are solved for, where they are fewer than this share of the frequencies."""


class MissingSamples:
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
        self._lost = [torch.nonzero(one == 0).flatten() for one in counts.unbind(1)]
        self._bases: dict[int, Tensor] = {}

    def basis(self, channel: int) -> Float[Tensor, "K n"]:
        """The basis at the rejected samples of a channel."""
        if channel not in self._bases:
            k = torch.arange(self._kept, dtype=self._sums.dtype).unsqueeze(-1)
            basis = torch.cos(math.pi / self._N * k * (self._lost[channel] + 0.5)) * math.sqrt(2.0 / self._N)
            basis[0] *= math.sqrt(0.5)
            self._bases[channel] = basis
        return self._bases[channel]

    def overlap(self, channel: int, rows: Tensor) -> Float[Tensor, "J K"]:
        """Inner products of the basis' functions of these numbers with all of it, over a channel's rejected samples."""
        K = self._kept
        # the sums at every difference of two numbers, and at every sum of two
        sums = torch.cat([self._sums[1:K, channel].flip(0), self._sums[: 2 * K - 1, channel]]) / self._N
        product = sums[: 2 * K - 1].unfold(0, K, 1)[K - 1 - rows] + sums[K - 1 :].unfold(0, K, 1)[rows]
        product[:, 0] *= math.sqrt(0.5)
        product[rows == 0] *= math.sqrt(0.5)
        return product

    def filling(self, noise_spectrum: NoiseSpectrum) -> Imputation:
        """The rejected samples' expectation under noise of this colour."""
        spectrum = noise_spectrum.root.square()
        K, m = spectrum.shape
        end = spectrum[-max(K // _END, 1) :].mean(0)
        excess = end / spectrum - 1.0
        parts: list[_ImputedPart | None] = []
        log_det = 0.0
        for channel in range(m):
            far = excess[:, channel].abs()
            rows = torch.nonzero(far > _PLAIN).flatten()
            lost = len(self._lost[channel])
            if len(rows) == 0 or lost == 0:
                parts.append(None)
                continue
            most = min(_MOST, max(_CELLS // K, 1))
            if len(rows) > most:
                rows = rows[far[rows].topk(most).indices].sort().values
            own = excess[rows, channel]
            # the same by either identity; what is solved is as large as the rejected samples, or as the frequencies
            few = lost < _HANDY * len(rows)
            part = self._by_sample(channel, rows, own) if few else self._by_frequency(channel, rows, own)
            log_det += part.log_det
            parts.append(part)
        return Imputation(tuple(parts), log_det)

    def _by_sample(self, channel: int, rows: Tensor, excess: Tensor) -> _ImputedPart:
        basis = self.basis(channel)
        weighed = (excess.unsqueeze(-1) * basis[rows]).mT
        eye = torch.eye(basis.shape[1], dtype=basis.dtype)
        root = torch.linalg.cholesky(eye + weighed @ basis[rows])
        return _ImputedPart(rows, basis, _BySample(weighed, root), 2.0 * float(root.diagonal().log().sum()))

    def _by_frequency(self, channel: int, rows: Tensor, excess: Tensor) -> _ImputedPart:
        overlap = self.overlap(channel, rows)
        eye = torch.eye(len(rows), dtype=overlap.dtype)
        if bool((excess < 0.0).all()):
            half = excess.neg().sqrt()
            root, failed = torch.linalg.cholesky_ex(eye - half.unsqueeze(-1) * overlap[:, rows] * half)
            if not failed:
                log_det = 2.0 * float(root.diagonal().log().sum())
                return _ImputedPart(rows, overlap.mT, _Louder(half.unsqueeze(-1), root), log_det)
        factors, pivots = torch.linalg.lu_factor(eye + excess.unsqueeze(-1) * overlap[:, rows])
        pulling = _ByFrequency(excess.unsqueeze(-1), factors, pivots)
        return _ImputedPart(rows, overlap.mT, pulling, float(factors.diagonal().abs().log().sum()))


@dataclass(frozen=True)
class _BySample:
    """``(1 + Bᵀ E B)⁻¹ Bᵀ E`` with B the basis at the rejected samples, E the excess."""

    weighed: Tensor  # (n, J), Bᵀ E
    root: Tensor  # (n, n)

    def __call__(self, values: Float[Tensor, "J c"]) -> Float[Tensor, "n c"]:
        return torch.cholesky_solve(self.weighed @ values, self.root)


@dataclass(frozen=True)
class _ByFrequency:
    """``(1 + E O)⁻¹ E`` with O the overlap, E the excess."""

    excess: Tensor  # (J, 1)
    factors: Tensor  # (J, J)
    pivots: Tensor  # (J,)

    def __call__(self, values: Float[Tensor, "J c"]) -> Float[Tensor, "J c"]:
        return torch.linalg.lu_solve(self.factors, self.pivots, self.excess * values)


@dataclass(frozen=True)
class _Louder:
    """The same where all excess is negative: the noise is nowhere below the level of its spectrum's end."""

    half: Tensor  # (J, 1), root of -E
    root: Tensor  # (J, J) of 1 - half O half

    def __call__(self, values: Float[Tensor, "J c"]) -> Float[Tensor, "J c"]:
        return -self.half * torch.cholesky_solve(self.half * values, self.root)


@dataclass(frozen=True)
class _ImputedPart:
    """What the rejected samples of a channel take: ``spread @ pulling(·)`` of the coefficients of these rows."""

    rows: Tensor  # (J,)
    spread: Tensor  # (K, n)
    pulling: _BySample | _ByFrequency | _Louder
    log_det: float

    def __call__(self, values: Float[Tensor, "K c"]) -> Float[Tensor, "K c"]:
        return torch.addmm(values, self.spread, self.pulling(values[self.rows]), alpha=-1.0)


@dataclass(frozen=True)
class Imputation:
    """What to add to the slowest cosine coefficients of series that are 0 at rejected samples.

    With P the precision of the noise, 1 at the end of its spectrum, x at the rejected samples m is
    ``-(P_mm)^-1 (P x)_m``; in the basis of cosines, and by the identity of Woodbury, this takes no more than the
    frequencies at which the noise is not white.

    Attributes:
        parts: one a channel; None where nothing is to be done.
        log_det: of ``P_mm``.
    """

    parts: tuple[_ImputedPart | None, ...]
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
