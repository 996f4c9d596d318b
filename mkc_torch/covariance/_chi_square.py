"""The chi-square distribution, of which torch has the regularised incomplete gamma function."""

from __future__ import annotations

from functools import cache

import torch


def chi_square_cdf(x: float, p: int) -> float:
    """Probability that a chi-square variable of ``p`` degrees of freedom is at most ``x >= 0``."""
    half = torch.tensor([0.5 * p, 0.5 * x], dtype=torch.float64)
    return float(torch.special.gammainc(half[0], half[1]))


@cache
def chi_square_quantile(q: float, p: int) -> float:
    """The value below which a chi-square variable of ``p`` degrees of freedom lies with probability ``0 < q < 1``."""
    low, high = 0.0, float(p)
    while chi_square_cdf(high, p) < q:
        low, high = high, 2.0 * high
    # halved until no number lies between the ends
    while low < (middle := 0.5 * (low + high)) < high:
        low, high = (middle, high) if chi_square_cdf(middle, p) < q else (low, middle)
    return high
