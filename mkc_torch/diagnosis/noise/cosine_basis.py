"""The cosine basis (DCT-II) in which stationary noise is nearly uncorrelated."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float


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
