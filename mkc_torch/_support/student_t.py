"""Tails and quantiles of Student's t, for intervals and p-values, in float64 and without a gradient.

With ``t = √f sinh u`` the density of u is ``K cosh(u)^-f``, log-concave for any degrees of freedom f. The tail is its
density times an integral of length 1 / f to 1 / √f, which a double-exponential rule gives to rounding.
"""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

_STEP = 1.0 / 12.0
"""Step of the double-exponential rule."""

_REACH = 4.0
"""Limits ±_REACH of the rule: the nodes are from 1e-25 to 50 characteristic lengths."""

_CENTRE_NODES = 40
"""Nodes of the Gauss-Legendre rule for the centre of the distribution."""

_NEWTON = 30
"""Largest number of Newton steps for a quantile; three to five are usual."""

_SETTLED = 1e-14
"""Relative change of u in the last step."""

_LARGE = 20.0
"""Argument of the gamma function from which the asymptotic series of the ratio of two values is exact to rounding."""

_AT_ONCE = 1 << 14
"""Number of values computed at once, to bound memory."""

_PLACES = np.arange(-_REACH, _REACH + 0.5 * _STEP, _STEP)
_NODES = np.exp(_PLACES - np.exp(-_PLACES))
_WEIGHTS = _STEP * _NODES * (1.0 + np.exp(-_PLACES))
"""Nodes and weights of Takahasi & Mori, "Double exponential formulas for numerical integration" (1974), table 1, for
integrals over (0, ∞) of functions that decay exponentially."""

_LEGENDRE = np.polynomial.legendre.leggauss(_CENTRE_NODES)


def student_tails(t: Float[Tensor, "*shape"], freedom: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """The probability of a Student t beyond ``±|t|``: a two-sided p-value.

    Args:
        t: any values, also infinite ones.
        freedom: degrees of freedom, at least 0.5; broadcast against ``t``.

    Example:
        >>> student_tails(torch.tensor(2.0), torch.tensor(10.0))
        tensor(0.0734, dtype=torch.float64)
    """
    t, freedom = torch.broadcast_tensors(t, freedom)
    size, f = _array(t.abs()).ravel(), _array(freedom).ravel()
    tails = np.empty_like(size)
    for first in range(0, len(size), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        u = np.arcsinh(size[part] / np.sqrt(f[part]))
        tails[part] = 2.0 * np.exp(_log_density(u, f[part])) * _mills_ratio(u, f[part])
    return torch.as_tensor(tails.reshape(t.shape), device=t.device)


def student_quantile(level: float, freedom: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """The t for which a Student t is within ±t with probability ``level``.

    Newton's method for the logarithm of the tail, or for the centre if that is smaller, as a function of u. Both are
    concave, so that the steps approach the root from one side; they start at Wallace's approximation.

    Args:
        level: probability in (0, 1).
        freedom: degrees of freedom, at least 0.5.

    References:
        Wallace, "Bounds on normal approximations to Student's and the chi-square distributions", Annals of
        Mathematical Statistics 30 (1959), section 3.

    Example:
        >>> student_quantile(0.95, torch.tensor([10.0, 1e6]))
        tensor([2.2281, 1.9600], dtype=torch.float64)
    """
    each, place = np.unique(_array(freedom), return_inverse=True)
    z = -NormalDist().inv_cdf(0.5 - 0.5 * level) if level < 0.5 else -NormalDist().inv_cdf(0.5 * (1.0 - level))
    half_log = 0.5 * (z * (8.0 * each + 3.0) / (8.0 * each + 1.0)) ** 2 / each
    u = half_log + np.log1p(np.sqrt(-np.expm1(-2.0 * half_log)))
    for _ in range(_NEWTON):
        log_density = _log_density(u, each)
        if level < 0.5:
            density = np.exp(log_density)
            change = 0.5 * level / density - _centre_ratio(u, each)
        else:
            ratio = _mills_ratio(u, each)
            change = (log_density + np.log(ratio) - math.log(0.5 * (1.0 - level))) * ratio
        u = u + change
        if (np.abs(change) <= _SETTLED * u).all():
            break
    quantile = np.sqrt(each) * np.sinh(u)
    return torch.as_tensor(quantile[place.reshape(freedom.shape)], device=freedom.device)


def _array(values: Tensor) -> np.ndarray:
    array: np.ndarray = values.detach().double().cpu().numpy()
    return array


def _log_density(u: np.ndarray, f: np.ndarray) -> np.ndarray:
    """Logarithm of the density of u, ``K cosh(u)^-f``."""
    # log cosh u without overflow, and without cancellation near 0
    near = np.minimum(u, 1.0)
    far = (u - near) + (np.log1p(np.exp(-2.0 * u)) - np.log1p(np.exp(-2.0 * near)))
    log_cosh = 0.5 * np.log1p(np.sinh(near) ** 2) + far
    return _log_gamma_ratio(0.5 * f) - 0.5 * math.log(math.pi) - f * log_cosh


def _mills_ratio(u: np.ndarray, f: np.ndarray) -> np.ndarray:
    """The tail beyond u divided by the density there: ``∫ (cosh(u) / cosh(u + s))^f ds`` over s > 0."""
    slope = np.tanh(u)
    length = 1.0 / (f * slope + np.sqrt(f) / (1.0 + np.sqrt(1.0 / f)))
    s = length[..., None] * _NODES
    half = np.sinh(0.5 * s)
    # cosh(u + s) / cosh(u) - 1 = cosh(s) - 1 + sinh(s) tanh(u)
    growth = np.log1p(2.0 * half * (half + np.cosh(0.5 * s) * slope[..., None]))
    return length * (np.exp(-f[..., None] * growth) @ _WEIGHTS)


def _centre_ratio(u: np.ndarray, f: np.ndarray) -> np.ndarray:
    """The probability of (0, u) divided by the density at u."""
    nodes, weights = _LEGENDRE
    s = 0.5 * u[..., None] * (1.0 + nodes)
    growth = np.log1p(np.sinh(u)[..., None] ** 2) - np.log1p(np.sinh(s) ** 2)
    return 0.5 * u * (np.exp(0.5 * f[..., None] * growth) @ weights)


def _log_gamma_ratio(x: np.ndarray) -> np.ndarray:
    """``log Γ(x + 1/2) - log Γ(x)``; the difference itself would lose digits for large x."""
    small = torch.as_tensor(np.minimum(x, _LARGE))
    difference = (torch.lgamma(small + 0.5) - torch.lgamma(small)).numpy()
    y = 1.0 / np.maximum(x, _LARGE)
    square = y * y
    tail = 1.0 / 192.0 - square * (1.0 / 640.0 - square * (17.0 / 14336.0 - square * 31.0 / 18432.0))
    series = -0.5 * np.log(y) - y / 8.0 + y * square * tail
    return np.where(x < _LARGE, difference, series)
