"""The noise that structure is tested against: heavy-tailed, coloured, and wandering at the simulation's ports.

Residuals enter as pseudo-residuals, the bounded values whose least squares are the M-estimate to first order (Huber,
"Robust Statistics", 1981, 7.6). In the basis of cosines (DCT-II) stationary noise is nearly independent from one
coefficient to the next, and a random walk exactly so; dividing by the root of the spectrum makes it white.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.noise.cosine_basis import dct

if TYPE_CHECKING:
    from jaxtyping import Float, Int

__all__ = [
    "NoiseSpectrum",
    "autoregression",
    "autoregressive",
    "colour_of",
    "colour_of_fast",
    "correlation_time",
    "enters_at_port",
    "filtered",
    "port_colour",
    "whittle",
]

MAX_ORDER = 12
"""Highest order of the autoregression."""

_FILLED = 10
"""Times that what does not count is filled in."""


@dataclass(frozen=True)
class NoiseSpectrum:
    """The spectrum of each channel's stationary noise as an autoregression; order 0 is white.

    Attributes:
        coefficients: φ of ``e[t] = Σ φ_j e[t-j] + innovation``, one tensor a channel.
        root: (K, m), root of the spectrum on the K slowest frequencies of the cosine basis, on any one scale.
    """

    coefficients: tuple[Tensor, ...]
    root: Float[Tensor, "K m"]

    @property
    def order(self) -> int:
        return max(len(c) for c in self.coefficients)

    def whiten(self, values: Float[Tensor, "N m *rest"]) -> Float[Tensor, Km * rest]:
        """The slowest cosine coefficients over the root of the spectrum, as many as ``root`` has, channels stacked."""
        return self.scaled(dct(values, len(self.root)))

    def scaled(self, coefficients: Float[Tensor, "K m *rest"]) -> Float[Tensor, Km * rest]:
        """The same of what is in the cosine basis already."""
        root = self.root.reshape(*self.root.shape, *[1] * (coefficients.dim() - 2)).to(coefficients.dtype)
        return (coefficients / root).flatten(0, 1)


_SHARED, _CLEARLY = 0.5, 1.01
"""Share of a port's axes that two samples have in common for their product to tell of noise at the port, and times that
noise at a port has to explain the products better than the residual's own."""


def port_colour(values: Float[Tensor, "N m"], pointwise: Float[Tensor, "N m c"]) -> Tensor:
    """Autoregression of noise that enters at a port, alike and independent in its channels, and gives these residuals.

    Where the port's axes turn against the residual, ``cov_residual(lag) = cov_port(lag) · mean(P[t] P[t + lag]ᵀ)``.
    """
    N = values.shape[0]
    highest = min(MAX_ORDER, N // 10)
    covariance = _autocovariance(values, highest).sum(-1)
    overlap = torch.stack([(pointwise[: N - lag] * pointwise[lag:]).sum() / N for lag in range(highest + 1)])
    ratio = overlap / overlap[0]
    # where the port has turned away, the residuals say too little about it
    known = int((ratio < _SHARED).long().argmax()) if bool((ratio < _SHARED).any()) else len(ratio)
    return _up_to_order(_levinson((covariance[:known] / ratio[:known]).unsqueeze(-1), N * values.shape[1])[:, 0])


def enters_at_port(values: Float[Tensor, "N m"], pointwise: Float[Tensor, "N m c"]) -> bool:
    """Whether coloured noise is rather that of a port whose axes turn against the residual than the residual's own.

    Products of residuals some samples apart are in proportion to how much of the port's axes they share, or to nothing:
    that which leaves the smaller squares over all lags decides; where they are alike, it is the residual's own.
    """
    N = len(values)
    through, own = 0.0, 0.0
    lag = 1
    while lag <= N // 20:
        product = (values[:-lag] * values[lag:]).flatten()
        overlap = (pointwise[:-lag] * pointwise[lag:]).sum(-1).flatten()
        used = overlap != 0
        product, overlap = product[used], overlap[used]
        if len(product) > 2:
            through += float((product @ overlap).square() / (overlap @ overlap))
            own += float(product.sum().square() / len(product))
        lag = math.ceil(1.5 * lag)
    return through > _CLEARLY * own


def autoregression(values: Float[Tensor, " N"]) -> Tensor:
    """Coefficients of the autoregression of a series, of an order by BIC.

    Example:
        >>> draws = autoregressive(torch.tensor([0.8], dtype=torch.float64), 4000, 1, torch.Generator().manual_seed(0))
        >>> autoregression(draws[:, 0])
        tensor([0.7...], dtype=torch.float64)
    """
    return _up_to_order(
        _levinson(_autocovariance(values.unsqueeze(-1), min(MAX_ORDER, len(values) // 10)), len(values))[:, 0]
    )


def correlation_time(values: Float[Tensor, " N"]) -> float:
    """Integrated autocorrelation time of a series, in samples, by its autoregression; 1 of white noise.

    Sokal, "Monte Carlo methods in statistical mechanics", in Functional Integration (1997), (2.16).

    Example:
        >>> draws = autoregressive(torch.tensor([0.8], dtype=torch.float64), 4000, 1, torch.Generator().manual_seed(0))
        >>> round(correlation_time(draws[:, 0]), 0), (1 + 0.8) / (1 - 0.8)
        (9.0, 9.000000000000002)
    """
    known = autoregression(values)
    if len(known) == 0:
        return 1.0
    frequency = torch.linspace(0.0, math.pi, 4096, dtype=known.dtype)
    spectrum = _root(known, frequency).square()
    return max(float(spectrum[0] / spectrum.mean()), 1.0)


def filtered(values: Float[Tensor, " N"], coefficients: Tensor) -> Float[Tensor, " N"]:
    """What an autoregression does not predict from the samples before; of those before the first it knows nothing."""
    left = values.clone()
    for lag, coefficient in enumerate(coefficients, 1):
        left[lag:] -= coefficient * values[:-lag]
    return left


def autoregressive(coefficients: Tensor, N: int, count: int, generator: torch.Generator) -> Float[Tensor, "N count"]:
    """Stationary draws of an autoregression whose innovations have variance one."""
    # a circle three times as long, of which a third is used, hides that it closes; its length is even
    length = 3 * (N + N % 2)
    frequency = torch.arange(length // 2 + 1, dtype=torch.float64) * (2 * math.pi / length)
    # drawn where white noise is white too; the two ends of its spectrum are real
    drawn = torch.randn(count, len(frequency), generator=generator, dtype=torch.complex128)
    drawn[:, [0, -1]] *= math.sqrt(2.0)
    drawn *= math.sqrt(length) * _root(coefficients, frequency)
    return torch.fft.irfft(drawn, n=length)[:, :N].mT


def colour_of(power: Float[Tensor, "K m"]) -> NoiseSpectrum:
    """The spectrum of each channel from the squares of its K slowest cosine coefficients.

    It is the product of three: a slow part that rises towards low frequencies, of the likeliest size and corner
    (Whittle's likelihood); an autoregression by Levinson's recursion, of an order by BIC; and local averages of what
    these two miss, over the more coefficients the higher the frequency.

    The constant says nothing of a spectrum: it may be an offset. Its neighbour stands in for it.

    Whittle, "Estimation and information in stationary time series", Arkiv för Matematik 2 (1953).
    """
    phi, spectrum = _spectra(power)
    return NoiseSpectrum(tuple(_up_to_order(one) for one in phi.unbind(-1)), spectrum.sqrt())


def colour_of_fast(power: Float[Tensor, "K m"], first: Int[Tensor, " m"]) -> NoiseSpectrum:
    """The spectrum of an autoregression that the coefficients of each channel have from its ``first`` on.

    What the slower ones would be follows from it (the EM algorithm for missing data: they are set to their expectation
    under the present one), as is right where something else is in them that is not to be looked at.

    Args:
        power: squares of the K slowest cosine coefficients.
        first: number of the first one that counts.

    Example:
        >>> noise = torch.randn(3000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> noise[:100] *= 50.0
        >>> root = colour_of_fast(noise.square().unsqueeze(-1), torch.tensor([100])).root
        >>> bool((root[:100] < 1.2).all())
        True
    """
    K = len(power)
    counts = torch.arange(K).unsqueeze(-1) >= first
    level = torch.where(counts, power, 0.0).sum(0) / counts.sum(0).clamp(min=1)
    filled = torch.where(counts, power, level)
    for _ in range(_FILLED):
        phi = _autoregression(filled)
        spectrum = _spectrum(phi, K)
        level = torch.where(counts, power / spectrum, 0.0).sum(0) / counts.sum(0).clamp(min=1)
        filled = torch.where(counts, power, level * spectrum)
    return NoiseSpectrum(
        tuple(_up_to_order(one) for one in phi.unbind(-1)), (level * spectrum).clamp(min=1e-300).sqrt()
    )


def _up_to_order(phi: Float[Tensor, " highest"]) -> Float[Tensor, " order"]:
    """Without the zeros beyond the last coefficient."""
    known = torch.nonzero(phi).flatten().tolist()
    return phi[: known[-1] + 1 if known else 0]


def whittle(power: Float[Tensor, "K B"]) -> Float[Tensor, " B"]:
    """Log-likelihood of series by the colour that :func:`colour_of` finds for each, up to a constant.

    Args:
        power: squares of the K slowest cosine coefficients of each.

    Example:
        >>> white = torch.randn(400, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> slow = white / torch.arange(1, 401)  # as much as one number of a white series is worth
        >>> of_white, of_slow = whittle(torch.stack([white, slow], -1).square())
        >>> bool(of_slow > of_white)
        True
    """
    spectrum = _spectra(power)[1]
    return -0.5 * (spectrum.log().sum(0) + len(power) * (power / spectrum).mean(0).clamp(min=1e-300).log())


def _spectra(power: Float[Tensor, "K B"]) -> tuple[Float[Tensor, "order B"], Float[Tensor, "K B"]]:
    """Autoregression and spectrum of each series."""
    power = torch.cat([power[1:2], power[1:]])
    phi, shape = _shape(power)
    return phi, shape * _local_mean(power / shape)


def _shape(power: Float[Tensor, "K B"]) -> tuple[Float[Tensor, "order B"], Float[Tensor, "K B"]]:
    """Autoregression, and the spectrum that it and a slow part make, whichever of the two is read first."""
    K = len(power)
    alone = _autoregression(power)
    first = _spectrum(alone, K)
    slow = _slow_part(power)
    beside = _autoregression(power / slow)
    one, other = first * _slow_part(power / first), slow * _spectrum(beside, K)
    lack = [spectrum.log().mean(0) + (power / spectrum).mean(0).log() for spectrum in (one, other)]
    nearer = lack[0] <= lack[1]
    return torch.where(nearer, alone, beside), torch.where(nearer, one, other)


def _autoregression(power: Float[Tensor, "K B"]) -> Float[Tensor, "order B"]:
    K = len(power)
    lag = torch.arange(min(MAX_ORDER, K // 10) + 1, dtype=power.dtype)
    return _levinson(torch.cos(lag.unsqueeze(-1) * _frequencies(K, power)) @ power / K, K)


def _spectrum(phi: Float[Tensor, "order B"], K: int) -> Float[Tensor, "K B"]:
    return _root(phi, _frequencies(K, phi)).square()


def _frequencies(K: int, like: Tensor) -> Float[Tensor, " K"]:
    """The K slowest coefficients are those of a series that was thinned to K samples."""
    return (torch.arange(K, dtype=like.dtype) + 0.5) * (math.pi / K)


def _slow_part(power: Float[Tensor, "K B"]) -> Float[Tensor, "K B"]:
    """``1 + size · shape`` with the likeliest of a grid of sizes and shapes; the level is profiled out."""
    K = len(power)
    k = torch.arange(K, dtype=power.dtype).clamp(min=1.0)  # the first one is the constant
    shapes = [k.pow(-2), *(1.0 / (1.0 + (k / corner).square()) for corner in (3.0, 10.0, 30.0))]
    sizes = torch.logspace(-1.0, 7.0, 25, dtype=power.dtype)
    spectra = 1.0 + (torch.stack(shapes).unsqueeze(1) * sizes.unsqueeze(-1)).flatten(0, 1)
    spectra = torch.cat([torch.ones_like(spectra[:1]), spectra])
    value = spectra.log().sum(-1, keepdim=True) + K * (spectra.reciprocal() @ power / K).clamp(min=1e-300).log()
    return spectra[value.argmin(0)].mT


def _local_mean(values: Float[Tensor, "K m"]) -> Float[Tensor, "K m"]:
    """Mean over a neighbourhood of each row, of an eighth of its number to either side, and ten rows at least."""
    K = len(values)
    index = torch.arange(K)
    half = torch.clamp(index // 8, min=10)
    low, high = (index - half).clamp(min=0), (index + half + 1).clamp(max=K)
    low = torch.minimum(low, (high - 21).clamp(min=0))
    high = torch.maximum(high, (low + 21).clamp(max=K))
    total = torch.cat([values.new_zeros(1, values.shape[1]), values.cumsum(0)])
    return (total[high] - total[low]) / (high - low).unsqueeze(-1)


def _root(phi: Float[Tensor, order * B], frequency: Float[Tensor, " K"]) -> Float[Tensor, K * B]:
    """Root of the spectrum of an autoregression with innovations of variance one."""
    phase = frequency.unsqueeze(-1) * torch.arange(1, len(phi) + 1, dtype=frequency.dtype)
    return torch.hypot(1.0 - torch.cos(phase) @ phi, torch.sin(phase) @ phi).reciprocal()


def _autocovariance(values: Tensor, highest: int) -> Float[Tensor, "lags m"]:
    N = values.shape[0]
    spectrum = torch.fft.rfft(values, n=2 * N, dim=0)
    return torch.fft.irfft(spectrum.abs().square(), n=2 * N, dim=0)[: highest + 1] / N


def _levinson(covariance: Float[Tensor, "lags B"], N: int) -> Float[Tensor, "order B"]:
    """Autoregressions from autocovariances by Levinson's recursion, their orders by BIC on N samples; 0 beyond them.

    Estimates that are those of no series, as where the turns of a port have been divided out, count up to where they
    could be; one lag that is larger than the variance is the slowest noise there is.
    """
    highest = len(covariance) - 1
    some = covariance[0] > 0
    variance = torch.where(some, covariance[0], 1.0)
    phi = torch.zeros_like(covariance[1:])
    best, lowest = phi.clone(), N * variance.log()
    for order in range(1, highest + 1):
        past = phi[: order - 1]
        reflection = (covariance[order] - (past * covariance[1:order].flip(0)).sum(0)) / variance
        known = reflection.abs() < 1.0
        reflection = reflection.clamp(-0.999, 0.999)
        phi = torch.cat([past - reflection * past.flip(0), reflection.unsqueeze(0), phi[order:]])
        variance = variance * (1.0 - reflection.square())
        score = N * variance.log() + order * math.log(N)
        better = (some if order == 1 else some & known) & (score < lowest)
        best, lowest = torch.where(better, phi, best), torch.where(better, score, lowest)
        some = some & known
    return best
