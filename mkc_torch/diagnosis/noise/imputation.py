"""Imputation: expected coloured noise at the rejected samples, given the samples around them.

For white noise, 0 in place of a rejected sample is right. For a drift, zeros cut holes that spread to all frequencies.
The expectation is linear in the samples that count: applied to the residual and to all tangents alike, it leaves the
estimated sizes of effects unbiased.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.noise.spectrum import NoiseSpectrum, dct

if TYPE_CHECKING:
    from jaxtyping import Float

PLAIN = 0.3
"""Relative distance to the level of its high-frequency end within which a spectrum counts as white."""

END = 20
"""The highest 1/20 of the frequencies set the level of the spectrum's end."""

_MOST = 1000
"""Largest number of frequencies that are not treated as white; the farthest from white are kept."""

_CELLS = 20_000_000
"""Largest number of products of these frequencies with all others."""

_HANDY = 0.5
"""Number of rejected samples, as a share of the frequencies, below which the system is solved by samples."""


class MissingSamples:
    """The rejected samples of each channel.

    Args:
        counts: 0 for a rejected sample, else 1.
        kept: number K of the slowest cosine coefficients in use.
    """

    def __init__(self, counts: Float[Tensor, "N m"], kept: int) -> None:
        N = len(counts)
        self._N, self._kept = N, kept
        known = dct(1.0 - counts) * math.sqrt(N / 2)
        known[0] *= math.sqrt(2.0)
        # sums of cosines at the rejected samples; beyond the N-th frequency they are mirrored, with the opposite sign
        self._sums = torch.cat([known, torch.zeros_like(known[:1]), -known[1:].flip(0)])
        self._lost = [torch.nonzero(mask == 0).flatten() for mask in counts.unbind(1)]
        self._bases: dict[int, Tensor] = {}

    def basis(self, channel: int) -> Float[Tensor, "K n"]:
        """Return the cosine basis at the rejected samples of a channel, (K, n)."""
        if channel not in self._bases:
            k = torch.arange(self._kept, dtype=self._sums.dtype).unsqueeze(-1)
            basis = torch.cos(math.pi / self._N * k * (self._lost[channel] + 0.5)) * math.sqrt(2.0 / self._N)
            basis[0] *= math.sqrt(0.5)
            self._bases[channel] = basis
        return self._bases[channel]

    def overlap(self, channel: int, rows: Tensor) -> Float[Tensor, "J K"]:
        """Return inner products (J, K) of the basis functions ``rows`` with all, over a channel's rejected samples."""
        K = self._kept
        # the sums at every difference and every sum of two frequency numbers
        sums = torch.cat([self._sums[1:K, channel].flip(0), self._sums[: 2 * K - 1, channel]]) / self._N
        product = sums[: 2 * K - 1].unfold(0, K, 1)[K - 1 - rows] + sums[K - 1 :].unfold(0, K, 1)[rows]
        product[:, 0] *= math.sqrt(0.5)
        product[rows == 0] *= math.sqrt(0.5)
        return product

    def filling(self, noise_spectrum: NoiseSpectrum) -> Imputation:
        """Return the imputation of the rejected samples under this noise spectrum."""
        spectrum = noise_spectrum.root.square()
        K, m = spectrum.shape
        end = spectrum[-max(K // END, 1) :].mean(0)
        excess = end / spectrum - 1.0
        parts: list[_ImputedPart | None] = []
        log_det = 0.0
        for channel in range(m):
            far = excess[:, channel].abs()
            rows = torch.nonzero(far > PLAIN).flatten()
            lost = len(self._lost[channel])
            if len(rows) == 0 or lost == 0:
                parts.append(None)
                continue
            most = min(_MOST, max(_CELLS // K, 1))
            if len(rows) > most:
                rows = rows[far[rows].topk(most).indices].sort().values
            own = excess[rows, channel]
            # both identities give the same result; solve the smaller system, by samples or by frequencies
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
    """The same for negative excess: the noise is nowhere below the level of its spectrum's end."""

    half: Tensor  # (J, 1), root of -E
    root: Tensor  # (J, J) of 1 - half O half

    def __call__(self, values: Float[Tensor, "J c"]) -> Float[Tensor, "J c"]:
        return -self.half * torch.cholesky_solve(self.half * values, self.root)


@dataclass(frozen=True)
class _ImputedPart:
    """Correction for a channel's rejected samples: ``spread @ pulling(·)`` of the coefficients of these rows."""

    rows: Tensor  # (J,)
    spread: Tensor  # (K, n)
    pulling: _BySample | _ByFrequency | _Louder
    log_det: float

    def __call__(self, values: Float[Tensor, "K c"]) -> Float[Tensor, "K c"]:
        return torch.addmm(values, self.spread, self.pulling(values[self.rows]), alpha=-1.0)


@dataclass(frozen=True)
class Imputation:
    """The imputation, applied to the slowest cosine coefficients of series that are 0 at rejected samples.

    With P the precision of the noise, 1 at the end of its spectrum, x at the rejected samples m is
    ``-(P_mm)^-1 (P x)_m``; in the cosine basis, and by Woodbury's identity, it needs only the frequencies at which the
    noise is not white.

    Attributes:
        parts: one per channel; None if the channel needs no correction.
        log_det: of ``P_mm``.
    """

    parts: tuple[_ImputedPart | None, ...]
    log_det: float

    @property
    def nothing(self) -> bool:
        """Whether no channel needs a correction."""
        return all(part is None for part in self.parts)

    def __call__(self, coefficients: Float[Tensor, "K m *rest"]) -> Float[Tensor, "K m *rest"]:
        if self.nothing or coefficients.numel() == 0:
            return coefficients
        flat = coefficients.flatten(2) if coefficients.dim() > 2 else coefficients.unsqueeze(-1)
        filled = [
            values if part is None else part(values) for part, values in zip(self.parts, flat.unbind(1), strict=True)
        ]
        return torch.stack(filled, 1).view_as(coefficients)
