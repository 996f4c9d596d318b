"""Distributions of Student's t and Fisher's F, for intervals and p-values.

Both are incomplete beta functions, which torch lacks; they are computed by the continued fraction of DLMF 8.17.22 with
Lentz's method, in float64 and without a gradient.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

_STEPS = 2000
"""Maximum number of terms of the continued fraction; twice the root of the larger parameter suffices."""

_NEWTON = 100
"""Largest number of Newton steps for a quantile; fewer than ten are usual, and more where few degrees of freedom have a
quantile of many thousands."""

_MOST = 0.7
"""Largest increase of log t in a step, so that the tails do not underflow."""

_SETTLED = 1e-14
"""Change of log t in the last step."""

_FREEDOM = 1e6
"""Limit of the degrees of freedom: beyond it quantiles are within 1e-6 of a Gaussian's."""


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


def student_tails(t: Tensor, freedom: Tensor) -> Tensor:
    """The probability of a Student t beyond ``±|t|``: a two-sided p-value.

    Example:
        >>> student_tails(torch.tensor(2.0), torch.tensor(10.0))
        tensor(0.0734, dtype=torch.float64)
    """
    t, freedom = t.detach().double(), freedom.detach().double().clamp(max=_FREEDOM)
    return incomplete_beta(0.5 * freedom, torch.tensor(0.5), freedom / (freedom + t.square()))


def fisher_tail(f: Tensor, over: Tensor, under: Tensor) -> Tensor:
    """The probability of a Fisher F above ``f``, with its numerator and denominator degrees of freedom.

    Example:
        >>> fisher_tail(torch.tensor(3.0), torch.tensor(2.0), torch.tensor(20.0))
        tensor(0.0725, dtype=torch.float64)
    """
    f, over, under = f.detach().double(), over.double(), under.detach().double().clamp(max=_FREEDOM)
    return incomplete_beta(0.5 * under, 0.5 * over, under / (under + over * f))


def student_quantile(level: float, freedom: Tensor) -> Tensor:
    """The t for which a Student t is within ±t with probability ``level``.

    Newton's method for the logarithm of the tails as a function of log t, or of the rest if that is smaller. Both are
    concave, so that the steps approach the root from one side.

    Example:
        >>> student_quantile(0.95, torch.tensor([10.0, 1e6]))
        tensor([2.2281, 1.9600], dtype=torch.float64)
    """
    freedom = freedom.detach().double().clamp(max=_FREEDOM)
    log_density = torch.lgamma(0.5 * freedom + 0.5) - torch.lgamma(0.5 * freedom) - 0.5 * torch.log(torch.pi * freedom)
    log_t, half = torch.zeros_like(freedom), torch.full_like(freedom, 0.5)
    goal, sign = (math.log1p(-level), 1.0) if level > 0.5 else (math.log(level), -1.0)
    for _ in range(_NEWTON):
        t = torch.exp(log_t)
        square = t.square()
        share, a, b = (freedom, 0.5 * freedom, half) if level > 0.5 else (square, half, 0.5 * freedom)
        found = incomplete_beta(a, b, share / (freedom + square))
        log_slope = log_density + log_t - (0.5 * freedom + 0.5) * torch.log1p(square / freedom)
        change = sign * (torch.log(found) - goal) * found / (2.0 * torch.exp(log_slope))
        log_t = log_t + change.clamp(max=_MOST)
        if bool((change.abs() < _SETTLED).all()):
            break
    return torch.exp(log_t)
