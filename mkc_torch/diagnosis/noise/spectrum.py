"""The spectrum of coloured noise, and the innovations that it leaves."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.diagnosis.noise.outliers import running_median

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


MAX_ORDER = 12
"""Highest order of the autoregression."""

_FILLED = 10
"""EM iterations for the coefficients that do not count."""

_SHARED = 0.5
"""Overlap of a port's axes at two samples from which their product informs about noise at the port."""

_CLEARLY = 1.01
"""Ratio of squares by which noise at a port has to explain the products better than the residual's own noise."""

_CLIPPED = 3.0
"""Robust standard deviations at which residuals are clipped around their running medians, and squares are clipped."""

_NEAR = 10
"""Samples to either side for the running median, which separates an outlier from a slow course."""


@dataclass(frozen=True)
class NoiseSpectrum:
    """The spectrum of each channel's stationary noise as an autoregression; order 0 is white.

    Attributes:
        coefficients: φ of ``e[t] = Σ φ_j e[t-j] + innovation``, one tensor per channel.
        root: (K, m), root of the spectrum on the K slowest frequencies of the cosine basis, on any common scale.
    """

    coefficients: tuple[Tensor, ...]
    root: Float[Tensor, "K m"]

    @property
    def order(self) -> int:
        return max(len(c) for c in self.coefficients)

    def scaled(self, coefficients: Float[Tensor, "K m *rest"]) -> Float[Tensor, Km * rest]:
        """Return cosine coefficients divided by the root of the spectrum, channels stacked."""
        root = self.root.reshape(*self.root.shape, *[1] * (coefficients.dim() - 2)).to(coefficients.dtype)
        return (coefficients / root).flatten(0, 1)


def port_autoregression(values: Float[Tensor, "N m"], pointwise: Float[Tensor, "N m c"]) -> Tensor:
    """Return the autoregression of noise at a port, equal and independent in its channels, from the residuals.

    If the port's axes turn against the residual, ``cov_residual(lag) = cov_port(lag) · mean(P[t] P[t + lag]ᵀ)``.
    """
    N = values.shape[0]
    highest = min(MAX_ORDER, N // 10)
    covariance = _autocovariance(values, highest).sum(-1)
    overlap = torch.stack([(pointwise[: N - lag] * pointwise[lag:]).sum() / N for lag in range(highest + 1)])
    ratio = overlap / overlap[0]
    # at lags where the port has turned away, the residuals hold too little information
    known = int((ratio < _SHARED).long().argmax()) if bool((ratio < _SHARED).any()) else len(ratio)
    return _up_to_order(_levinson((covariance[:known] / ratio[:known]).unsqueeze(-1), N * values.shape[1])[:, 0])


def enters_at_port(values: Float[Tensor, "N m"], pointwise: Float[Tensor, "N m c"]) -> bool:
    """Whether coloured noise enters at a port whose axes turn against the residual, rather than in the residual itself.

    Products of residuals at a lag are proportional to the overlap of the port's axes in the first case, constant in the
    second. The model that explains more squares over all lags is taken; the residual's own noise if both are equal.
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
    """Return the autoregression coefficients of a series, with the order by BIC.

    Example:
        >>> draws = autoregressive(torch.tensor([0.8], dtype=torch.float64), 4000, 1, torch.Generator().manual_seed(0))
        >>> autoregression(draws[:, 0])
        tensor([0.7...], dtype=torch.float64)
    """
    return _up_to_order(
        _levinson(_autocovariance(values.unsqueeze(-1), min(MAX_ORDER, len(values) // 10)), len(values))[:, 0]
    )


def correlation_time(values: Float[Tensor, " N"]) -> float:
    """Return the integrated autocorrelation time of a series in samples, by its autoregression; 1 for white noise.

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
    """Return the innovations of a series under an autoregression; values before the first sample count as 0."""
    left = values.clone()
    for lag, coefficient in enumerate(coefficients, 1):
        left[lag:] -= coefficient * values[:-lag]
    return left


def autoregressive(coefficients: Tensor, N: int, count: int, generator: torch.Generator) -> Float[Tensor, "N count"]:
    """Return stationary draws of an autoregression whose innovations have variance 1, (N, count)."""
    # draw a periodic series three times as long and use a third of it, so that the period does not show; even length
    length = 3 * (N + N % 2)
    frequency = torch.arange(length // 2 + 1, dtype=torch.float64) * (2 * math.pi / length)
    # draw in the frequency domain; the two ends of a real series' spectrum are real
    drawn = torch.randn(count, len(frequency), generator=generator, dtype=torch.complex128)
    drawn[:, [0, -1]] *= math.sqrt(2.0)
    drawn *= math.sqrt(length) * _root(coefficients, frequency)
    return torch.fft.irfft(drawn, n=length)[:, :N].mT


def spectrum_of(power: Float[Tensor, "K m"]) -> NoiseSpectrum:
    """Return the spectrum of each channel from the squares of its K slowest cosine coefficients.

    The spectrum is the product of three factors: a slow part that rises towards low frequencies, of the most likely
    size and corner (Whittle's likelihood); an autoregression by Levinson's recursion, of an order by BIC; and local
    averages of what these two miss, over a width that grows with the frequency.

    The constant may be an offset and carries no information; its neighbour replaces it.

    Whittle, "Estimation and information in stationary time series", Arkiv för Matematik 2 (1953).
    """
    phi, spectrum = _spectra(power)
    return NoiseSpectrum(tuple(_up_to_order(channel) for channel in phi.unbind(-1)), spectrum.sqrt())


def spectrum_of_fast(power: Float[Tensor, "K m"], first: Int[Tensor, " m"]) -> NoiseSpectrum:
    """Return the spectrum of an autoregression from the coefficients of each channel from ``first`` on.

    The slower coefficients may hold something else, such as a drift. They are treated as missing data: the EM algorithm
    sets their squares to their expectation under the present spectrum.

    Args:
        power: squares of the K slowest cosine coefficients.
        first: number of the first coefficient that counts.

    Example:
        >>> noise = torch.randn(3000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> noise[:100] *= 50.0
        >>> root = spectrum_of_fast(noise.square().unsqueeze(-1), torch.tensor([100])).root
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
        tuple(_up_to_order(channel) for channel in phi.unbind(-1)), (level * spectrum).clamp(min=1e-300).sqrt()
    )


def _up_to_order(phi: Float[Tensor, " highest"]) -> Float[Tensor, " order"]:
    """Drop the zeros after the last coefficient."""
    known = torch.nonzero(phi).flatten().tolist()
    return phi[: known[-1] + 1 if known else 0]


def whittle(power: Float[Tensor, "K B"]) -> Float[Tensor, " B"]:
    """Return the log-likelihood of series under the spectrum that :func:`spectrum_of` finds for each, up to a constant.

    Args:
        power: squares of the K slowest cosine coefficients of each series.

    Example:
        >>> white = torch.randn(400, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> slow = white / torch.arange(1, 401)  # nearly all power in the first few coefficients
        >>> of_white, of_slow = whittle(torch.stack([white, slow], -1).square())
        >>> bool(of_slow > of_white)
        True
    """
    spectrum = _spectra(power)[1]
    return -0.5 * (spectrum.log().sum(0) + len(power) * (power / spectrum).mean(0).clamp(min=1e-300).log())


def _spectra(power: Float[Tensor, "K B"]) -> tuple[Float[Tensor, "order B"], Float[Tensor, "K B"]]:
    """Return autoregression and spectrum of each series."""
    power = torch.cat([power[1:2], power[1:]])
    phi, shape = _shape(power)
    return phi, shape * _local_mean(power / shape)


def _shape(power: Float[Tensor, "K B"]) -> tuple[Float[Tensor, "order B"], Float[Tensor, "K B"]]:
    """Return the autoregression, and its spectrum times a slow part, fitted in the better of the two orders."""
    K = len(power)
    fast_first = _autoregression(power)
    fast = _spectrum(fast_first, K)
    slow = _slow_part(power)
    slow_first = _autoregression(power / slow)
    spectra = fast * _slow_part(power / fast), slow * _spectrum(slow_first, K)
    lack = [spectrum.log().mean(0) + (power / spectrum).mean(0).log() for spectrum in spectra]
    nearer = lack[0] <= lack[1]
    return torch.where(nearer, fast_first, slow_first), torch.where(nearer, *spectra)


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
    """Return ``1 + size · shape`` with the most likely of a grid of sizes and shapes; the level is profiled out."""
    K = len(power)
    k = torch.arange(K, dtype=power.dtype).clamp(min=1.0)  # the first coefficient is the constant
    shapes = [k.pow(-2), *(1.0 / (1.0 + (k / corner).square()) for corner in (3.0, 10.0, 30.0))]
    sizes = torch.logspace(-1.0, 7.0, 25, dtype=power.dtype)
    spectra = 1.0 + (torch.stack(shapes).unsqueeze(1) * sizes.unsqueeze(-1)).flatten(0, 1)
    spectra = torch.cat([torch.ones_like(spectra[:1]), spectra])
    value = spectra.log().sum(-1, keepdim=True) + K * (spectra.reciprocal() @ power / K).clamp(min=1e-300).log()
    return spectra[value.argmin(0)].mT


def _local_mean(values: Float[Tensor, "K m"]) -> Float[Tensor, "K m"]:
    """Return the mean over a neighbourhood of each row: an eighth of its number to either side, at least ten rows."""
    K = len(values)
    index = torch.arange(K)
    half = torch.clamp(index // 8, min=10)
    low, high = (index - half).clamp(min=0), (index + half + 1).clamp(max=K)
    low = torch.minimum(low, (high - 21).clamp(min=0))
    high = torch.maximum(high, (low + 21).clamp(max=K))
    total = torch.cat([values.new_zeros(1, values.shape[1]), values.cumsum(0)])
    return (total[high] - total[low]) / (high - low).unsqueeze(-1)


def _root(phi: Float[Tensor, order * B], frequency: Float[Tensor, " K"]) -> Float[Tensor, K * B]:
    """Return the root of the spectrum of an autoregression with innovations of variance 1."""
    phase = frequency.unsqueeze(-1) * torch.arange(1, len(phi) + 1, dtype=frequency.dtype)
    return torch.hypot(1.0 - torch.cos(phase) @ phi, torch.sin(phase) @ phi).reciprocal()


def _autocovariance(values: Tensor, highest: int) -> Float[Tensor, "lags m"]:
    N = values.shape[0]
    spectrum = torch.fft.rfft(values, n=2 * N, dim=0)
    return torch.fft.irfft(spectrum.abs().square(), n=2 * N, dim=0)[: highest + 1] / N


def _levinson(covariance: Float[Tensor, "lags B"], N: int) -> Float[Tensor, "order B"]:
    """Return autoregressions from autocovariances by Levinson's recursion, orders by BIC; 0 beyond the order.

    Autocovariances that belong to no series, such as those divided by the rotation of a port, are used up to the last
    valid lag; a covariance larger than the variance at lag 1 counts as the slowest noise.
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


def innovation_gain(
    before: Float[Tensor, "N m"], after: Float[Tensor, "N m"], recorded: Bool[Tensor, "N m"] | None = None
) -> float:
    """Return the log-likelihood gain of ``after`` over ``before`` in nats.

    Both residuals, clipped around their running medians, are filtered by the autoregression of ``after``. The
    innovations are compared by squares clipped at three scales (Hampel et al., "Robust Statistics", 1986, 2.6).
    """
    if recorded is not None and before.shape == recorded.shape:  # each output at its own samples
        columns = zip(before.unbind(-1), after.unbind(-1), recorded.unbind(-1), strict=True)
        return sum(innovation_gain(b[used].unsqueeze(-1), a[used].unsqueeze(-1)) for b, a, used in columns)
    courses = [running_median(residual, min(_NEAR, len(residual) - 1)) for residual in (before, after)]
    reach = _CLIPPED * robust_scale(after - courses[1])
    tame = [
        course + (residual - course).clamp(-reach, reach)
        for residual, course in zip((before, after), courses, strict=True)
    ]
    total = 0.0
    for first, second in zip(*(values.unbind(-1) for values in tame), strict=True):
        coefficients = autoregression(second)
        new = torch.stack([filtered(first, coefficients), filtered(second, coefficients)])
        size = (new / robust_scale(new[1].unsqueeze(-1))).square().clamp(max=_CLIPPED**2).sum(-1)
        total += 0.5 * float(size[0] - size[1])
    return total


def agreed_innovation_gain(
    first: Float[Tensor, "N m"], other: Float[Tensor, "N m"], recorded: Bool[Tensor, "N m"] | None = None
) -> float:
    """Return the smaller gain of ``other`` over ``first`` in nats, over the noise models of both residuals.

    Negative if it loses under both, 0 if the two disagree.

    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> noise = torch.randn(400, 1, generator=generator, dtype=torch.float64)
        >>> decay = 2.0 * torch.exp(-(torch.arange(400) % 100) / 10.0).unsqueeze(-1)
        >>> agreed_innovation_gain(noise + decay, noise) > 10.0 > -10.0 > agreed_innovation_gain(noise, noise + decay)
        True
    """
    gains = innovation_gain(first, other, recorded), -innovation_gain(other, first, recorded)
    return max(min(gains), 0.0) + min(max(gains), 0.0)


def dct(values: Float[Tensor, N * rest], count: int | None = None) -> Float[Tensor, count * rest]:
    """Orthonormal cosine transform (DCT-II) over the first dimension, or the first ``count`` of its coefficients.

    Makhoul, "A fast cosine transform in one and two dimensions", IEEE Trans. ASSP 28 (1980).

    Example:
        >>> dct(torch.ones(4)).round(decimals=4) + 0.0
        tensor([2., 0., 0., 0.])
    """
    N = values.shape[0]
    count = N if count is None else min(count, N)
    if values.numel() == 0:
        return values[:count]
    folded = torch.cat([values[::2], values[1::2].flip(0)]).movedim(0, -1)
    spectrum = torch.fft.rfft(folded)
    if count > spectrum.shape[-1]:
        # the spectrum of a real series is symmetric
        spectrum = torch.cat([spectrum, spectrum[..., 1 : (N + 1) // 2].conj().flip(-1)], -1)
    angle = torch.arange(count, dtype=values.dtype, device=values.device) * (-math.pi / (2 * N))
    real = spectrum.real[..., :count] * torch.cos(angle) - spectrum.imag[..., :count] * torch.sin(angle)
    real = real * math.sqrt(2.0 / N)
    real[..., 0] *= math.sqrt(0.5)
    return real.movedim(-1, 0)


def inverse_dct(values: Float[Tensor, N * rest]) -> Float[Tensor, N * rest]:
    """The inverse of :func:`dct`.

    Example:
        >>> inverse_dct(dct(torch.tensor([1.0, 2.0, 4.0]))).round(decimals=4)
        tensor([1., 2., 4.])
    """
    N = values.shape[0]
    scaled = values.movedim(0, -1) * math.sqrt(N / 2)
    scaled[..., 0] *= math.sqrt(2.0)
    mirrored = torch.cat([torch.zeros_like(scaled[..., :1]), scaled[..., 1:].flip(-1)], -1)
    angle = torch.arange(N, dtype=values.dtype, device=values.device) * (math.pi / (2 * N))
    spectrum = torch.complex(scaled, -mirrored) * torch.polar(torch.ones_like(angle), angle)
    folded = torch.fft.ifft(spectrum).real
    out = torch.empty_like(folded)
    half = (N + 1) // 2
    out[..., ::2], out[..., 1::2] = folded[..., :half], folded[..., half:].flip(-1)
    return out.movedim(-1, 0)


def cosines(count: int, N: int, dtype: torch.dtype = torch.float64) -> Float[Tensor, "N count"]:
    """Return the first ``count`` slow cosines without the constant, (N, count), each with mean square 1."""
    k = torch.arange(1, count + 1, dtype=dtype)
    n = torch.arange(N, dtype=dtype) + 0.5
    return math.sqrt(2.0) * torch.cos(math.pi / N * n.unsqueeze(-1) * k)


def course_of(amplitudes: Float[Tensor, k * rest], N: int) -> Float[Tensor, N * rest]:
    """Return ``cosines(k, N) @ amplitudes``, by one transform.

    Example:
        >>> amplitudes = torch.tensor([[1.0, 0.0], [0.5, 2.0]], dtype=torch.float64)
        >>> torch.allclose(course_of(amplitudes, 20), cosines(2, 20) @ amplitudes)
        True
    """
    slow = torch.cat([torch.zeros_like(amplitudes[:1]), amplitudes])
    return inverse_dct(math.sqrt(N) * torch.cat([slow, slow.new_zeros(N - len(slow), *slow.shape[1:])]))


def dct_of_courses(values: Float[Tensor, "N m c"], courses: int, count: int) -> Float[Tensor, "count m k"]:
    """Return the slowest cosine coefficients of channels times slow cosines, k = courses · c, from c transforms.

    The same as ``dct(values[:, :, None] * cosines(courses, N)[:, None, :, None], count)``: a product of two cosines is
    the mean of the cosines of the sum and of the difference of their frequencies.

    Example:
        >>> values = torch.randn(20, 1, 1, dtype=torch.float64)
        >>> torch.allclose(dct_of_courses(values, 3, 20), dct(values * cosines(3, 20)[:, None]))
        True
    """
    N, m, c = values.shape
    count = min(count, N)
    known = dct(values).flatten(1).mT.contiguous()  # (m c, N)
    known[:, 0] *= math.sqrt(2.0)
    # beyond the N-th frequency the transform of N samples is mirrored, with the opposite sign
    beyond = torch.cat([known, torch.zeros_like(known[:, :1]), -known[:, 1:].flip(-1)], -1)
    both = torch.cat([known[:, 1 : courses + 1].flip(-1), beyond[:, : count + courses + 1]], -1)
    sums = beyond[:, 1 : count + courses].unfold(-1, count, 1)
    differences = both[:, : count + courses - 1].unfold(-1, count, 1).flip(1)
    out = (sums + differences).unflatten(0, (m, c)) * math.sqrt(0.5)  # (m, c, courses, count)
    out[..., 0] *= math.sqrt(0.5)
    return out.permute(3, 0, 2, 1).flatten(2)
