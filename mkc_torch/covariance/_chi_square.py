"""Chi-square distribution, from torch's regularised incomplete gamma function."""

from __future__ import annotations

from functools import cache

import torch


def chi_square_cdf(x: float, p: int) -> float:
    """Probability that a chi-square variable of ``p`` degrees of freedom is at most ``x >= 0``."""
    half = torch.tensor([0.5 * p, 0.5 * x], dtype=torch.float64)
    return float(torch.special.gammainc(half[0], half[1]))


@cache
def chi_square_quantile(q: float, p: int) -> float:
    """Quantile of the chi-square distribution of ``p`` degrees of freedom at probability ``0 < q < 1``."""
    low, high = 0.0, float(p)
    while chi_square_cdf(high, p) < q:
        low, high = high, 2.0 * high
    # bisection to the last bit
    while low < (middle := 0.5 * (low + high)) < high:
        low, high = (middle, high) if chi_square_cdf(middle, p) < q else (low, middle)
    return high
