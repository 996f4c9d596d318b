"""The effective number of independent samples of a time series."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float


def effective_size(values: Float[Tensor, " N"]) -> float:
    """Number of independent samples whose mean has the same variance: N over the integrated autocorrelation time.

    The autocorrelations are summed over pairs of lags up to the first negative pair. Geyer, "Practical Markov chain
    Monte Carlo", Statistical Science 7 (1992), 3.3.

    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> white = torch.randn(4000, generator=generator, dtype=torch.float64)
        >>> effective_size(white) > 3000, effective_size(white.repeat_interleave(10)) < 6000
        (True, True)
    """
    N = len(values)
    centred = values - values.mean()
    spectrum = torch.fft.rfft(centred, n=2 * N)
    covariance = torch.fft.irfft(spectrum.abs().square(), n=2 * N)[: N - N % 2]
    if float(covariance[0]) <= 0.0:
        return float(N)
    pairs = covariance.unflatten(0, (-1, 2)).sum(-1) / covariance[0]
    positive = (pairs > 0.0).to(pairs.dtype).cumprod(0)
    time = 2.0 * float((pairs * positive).sum()) - 1.0
    return N / max(time, 1.0)
