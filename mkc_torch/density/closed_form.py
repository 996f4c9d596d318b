"""Energy and first derivatives of each element, by formulas for both NumPy and torch.

Autograd on a formula of a dozen operations stores and reads a dozen arrays of the size of the batch, and calls torch
twice as often. Here the derivatives are computed with the value. They are not differentiable;
:mod:`mkc_torch.density.energy` has differentiable functions.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from mkc_torch._support.numpy_or_torch import at_least, at_most

_SERIES_BELOW = 0.3
"""x = kappa z² / 2 below which the derivative by kappa is a series: a difference of exponentials loses digits."""

_SERIES = tuple((-1) ** n / (math.factorial(n) * (n + 2)) for n in range(9))
"""Coefficients of ``(1 - exp(-x) (1 + x)) / x²``, with an error below 1e-11 at the largest x."""

_LEAST_EXPONENT = -1e4
"""Lower limit of exponents: exp(-1e4) is 0, and products with -1e4 do not overflow."""


class ElementEnergy(NamedTuple):
    """Energy of each element, and its derivatives by z and, if requested, by kappa."""

    value: Any
    by_z: Any
    by_kappa: Any


def element_energy(xp: Any, z: Any, kappa: Any, *, with_kappa: bool, has_gaussian: bool = True) -> ElementEnergy:
    """``energy(z, kappa)`` with its first derivatives.

    Args:
        xp: ``numpy`` or ``torch``, the library of the other arrays.
        z: standardised errors.
        kappa: ``1 / sigma² >= 0``, broadcast.
        with_kappa: whether to compute the derivative by kappa; else it is None.
        has_gaussian: whether any kappa may be 0.
    """
    minus_x = (z * (-0.5 * kappa)) * z  # this order gives 0 at kappa = 0, even where z² overflows
    value, inlier = -xp.expm1(minus_x), xp.exp(minus_x)
    if has_gaussian:
        value = xp.where(minus_x < 0, value / xp.where(kappa > 0, kappa, 1.0), 0.5 * z * z)
    else:
        value = value / kappa
    by_z = z * inlier
    if not with_kappa:
        return ElementEnergy(value, by_z, None)
    minus_x = at_least(xp, minus_x, _LEAST_EXPONENT)
    near_x = at_most(xp, -minus_x, _SERIES_BELOW)
    series = _SERIES[-1]
    for coefficient in _SERIES[-2::-1]:
        series = coefficient + near_x * series
    half = 0.5 * z * z
    far = (inlier * (1.0 - minus_x) - 1.0) / xp.where(kappa > 0, kappa, 1.0) ** 2
    return ElementEnergy(value, by_z, xp.where(minus_x > -_SERIES_BELOW, -half * half * series, far))
