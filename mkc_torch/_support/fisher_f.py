"""Tail probability of Fisher's F, for p-values.

It is an incomplete beta function, which torch lacks; it is computed by the continued fraction of DLMF 8.17.22 with
Lentz's method, in float64 and without a gradient.
"""

from __future__ import annotations

import torch
from torch import Tensor

_STEPS = 2000
"""Maximum number of terms of the continued fraction; twice the root of the larger parameter suffices."""

_FREEDOM = 1e6
"""Limit of the denominator's degrees of freedom: beyond it tails are within 1e-6 of a chi-square's."""


def incomplete_beta(a: Tensor, b: Tensor, x: Tensor) -> Tensor:
    """The regularised incomplete beta function ``I_x(a, b)``, for a, b > 0 and x in [0, 1].

    Example:
        >>> incomplete_beta(torch.tensor(2.0), torch.tensor(3.0), torch.tensor(0.4))
        tensor(0.5248, dtype=torch.float64)
    """
    a, b, x = torch.broadcast_tensors(*(v.detach().double() for v in (a, b, x)))
    # the continued fraction converges fast below the mean
    far = x > (a + 1.0) / (a + b + 2.0)
    p, q, y = torch.where(far, b, a), torch.where(far, a, b), torch.where(far, 1.0 - x, x)
    log_front = torch.xlogy(p, y) + q * torch.log1p(-y) - torch.log(p)
    log_front = log_front + torch.lgamma(p + q) - torch.lgamma(p) - torch.lgamma(q)
    value = torch.exp(log_front) * _fraction(p, q, y)
    return torch.where(far, 1.0 - value, value)


def _fraction(a: Tensor, b: Tensor, x: Tensor) -> Tensor:
    tiny = 1e-300
    c = torch.ones_like(x)
    d = 1.0 / _apart(1.0 - (a + b) * x / (a + 1.0), tiny)
    value = d
    for k in range(1, _STEPS):
        for term in (
            k * (b - k) * x / ((a + 2 * k - 1.0) * (a + 2 * k)),
            -(a + k) * (a + b + k) * x / ((a + 2 * k) * (a + 2 * k + 1.0)),
        ):
            d = 1.0 / _apart(1.0 + term * d, tiny)
            c = _apart(1.0 + term / c, tiny)
            value = value * c * d
        if bool(((c * d - 1.0).abs() < 1e-15).all()):
            break
    return value


def _apart(value: Tensor, tiny: float) -> Tensor:
    return torch.where(value.abs() < tiny, tiny, value)


def fisher_tail(f: Tensor, over: Tensor, under: Tensor) -> Tensor:
    """The probability of a Fisher F above ``f``, with its numerator and denominator degrees of freedom.

    Example:
        >>> fisher_tail(torch.tensor(3.0), torch.tensor(2.0), torch.tensor(20.0))
        tensor(0.0725, dtype=torch.float64)
    """
    f, over, under = f.detach().double(), over.double(), under.detach().double().clamp(max=_FREEDOM)
    return incomplete_beta(0.5 * under, 0.5 * over, under / (under + over * f))
