"""A Newton step of the density's likelihood in NumPy: for a single problem, torch's overhead per call dominates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from mkc_torch._support.torch_internals import is_wrapped
from mkc_torch.density.energy import KAPPA_MAX
from mkc_torch.density.head import HEAD_TOLERANCE, head_rule_constants

if TYPE_CHECKING:
    from jaxtyping import Float64
    from numpy import ndarray

KAPPA_OFFSET = 0.02
"""Offset of κ in relative steps, Δκ / (κ + offset): near a Gaussian small absolute changes matter."""

LONGEST_STEP = 2.0
"""Longest step, in log d and in relative κ."""

LEAST_KAPPA_SHARE = math.exp(-2.0)
"""Smallest factor on κ (plus its offset) in a step."""

_MOST = 1 << 16
"""Residuals up to which NumPy is faster than torch."""

_NODES, _WEIGHTS = (part.numpy() for part in head_rule_constants())


def is_short(error: Tensor) -> bool:
    """Whether these are the residuals of a single problem, few and in float64 on the CPU."""
    return (
        type(error) is Tensor
        and error.dim() == 3
        and error.shape[0] == 1
        and error.numel() <= _MOST
        and error.device.type == "cpu"
        and error.element_size() == 8
        and not error.requires_grad
        and not is_wrapped(error)
    )


@dataclass(frozen=True)
class Channel:
    """A channel's iterate: κ, log d, its limits, the damping and the mean negative log-likelihood."""

    kappa: float
    log_d: float
    log_bound: float
    log_d_min: float
    damping: float
    value: float


DerivativeValues = tuple[float, float, float, float, float, float]
"""Value, derivatives by κ and by log d, and second derivatives: by κ twice, by both, by log d twice."""


def channel_step(
    error: Float64[ndarray, " N"], weight: Float64[ndarray, " N"] | None, at: Channel, free_kappa: bool, free_d: bool
) -> tuple[float, float, float, float]:
    """Return κ, log d, damping and value after a Newton step that never increases the value.

    Args:
        error: residuals of the channel.
        weight: weights that sum to 1; None for equal weights.
        at: the iterate. The caller silences warnings of NumPy.
        free_kappa, free_d: whether κ and d are fitted.
    """
    total = [a + b for a, b in zip(_energy(error, weight, at), _normaliser(at), strict=True)]
    kappa, log_d = _proposed(total, at, free_kappa, free_d)
    z = error * math.exp(-log_d)
    half = 0.5 * z * z
    value = _mean(_energy_at(half, kappa), weight) + log_d + _log_partition(kappa, at.log_bound - log_d)
    if value <= total[0]:
        return kappa, log_d, max(0.1 * at.damping, 1e-9), value
    return at.kappa, at.log_d, min(10.0 * at.damping, 1e6), total[0]


def _mean(values: ndarray, weight: ndarray | None) -> float:
    return float(values.sum()) / len(values) if weight is None else float(weight @ values)


def _energy_at(q: ndarray, kappa: float) -> ndarray:
    x = kappa * q
    return np.where(x > 0, -np.expm1(-x) / (kappa if kappa > 0 else 1.0), q)


def _energy_terms(q: ndarray, kappa: float) -> tuple[ndarray, ndarray, ndarray, ndarray]:
    """exp(-x), E, -∂E/∂κ and ∂²E/∂κ² at q = z²/2, x = κ q; as :func:`mkc_torch.density.energy.energy_terms`."""
    x = kappa * q
    w = np.exp(-x)
    divisor = kappa if kappa > 0 else 1.0
    qw = q * w
    e = -np.expm1(-x) / divisor
    first = (e - qw) / divisor
    second = (2.0 * first - q * qw) / divisor
    small = x < 1e-5
    if small.any():
        q2 = q * q
        e = np.where(small, q - 0.5 * q * x, e)
        first = np.where(small, q2 * (0.5 - x / 3.0), first)
        second = np.where(small, q * q2 * (1.0 / 3.0 - 0.25 * x), second)
    return w, e, first, second


def _energy(error: ndarray, weight: ndarray | None, at: Channel) -> DerivativeValues:
    z = error * math.exp(-at.log_d)
    q = 0.5 * (z * z)
    w, e, first, second = _energy_terms(q, at.kappa)
    qw = q * w
    mean_qw, mean_q2w = _mean(qw, weight), _mean(q * qw, weight)
    return (
        _mean(e, weight),
        -_mean(first, weight),
        -2.0 * mean_qw,
        _mean(second, weight),
        2.0 * mean_q2w,
        4.0 * (mean_qw - at.kappa * mean_q2w),
    )


def _head(kappa: float, length: float) -> tuple[ndarray, ndarray, float]:
    """Nodes and weights on the head, as :func:`mkc_torch.density.head.head_rule`, and the density of the tail."""
    least = max(kappa, 1e-3)
    end = 1.0 / least + math.log(HEAD_TOLERANCE)
    excess = least * (max(end, 0.0) + math.log1p(math.exp(-abs(end))))
    end = min(length, math.sqrt(-2.0 * math.log(excess) / least))
    return end * _NODES, end * _WEIGHTS, math.exp(-1.0 / kappa) if kappa > 1e-3 else 0.0


def _integral(values: ndarray, tail: float, length: float, weights: ndarray) -> float:
    return 2.0 * length * tail + float(weights @ (values - tail))


def _log_partition(kappa: float, log_length: float) -> float:
    length = math.exp(log_length)
    nodes, weights, tail = _head(kappa, length)
    return math.log(_integral(np.exp(-_energy_at(0.5 * nodes * nodes, kappa)), tail, length, weights))


def _normaliser(at: Channel) -> DerivativeValues:
    """Derivatives of log(d Z); as :func:`mkc_torch.density.likelihood.normaliser_derivatives`."""
    kappa, length = at.kappa, math.exp(at.log_bound - at.log_d)
    nodes, weights, tail = _head(kappa, length)
    k = kappa if tail > 0 else 1.0
    _, e, first, second = _energy_terms(0.5 * nodes * nodes, kappa)
    p = np.exp(-e)
    z = _integral(p, tail, length, weights)
    z_k = _integral(first * p, tail / k**2, length, weights) / z
    z_kk = _integral((first * first - second) * p, tail * (1.0 - 2.0 * k) / k**4, length, weights) / z
    w_end, e_end, first_end = (float(part[0]) for part in _energy_terms(np.array([0.5 * length * length]), kappa)[:3])
    edge = 2.0 * math.exp(-e_end) / z
    l_1 = length * edge
    l_2 = length * l_1 * (-length * w_end - edge) + l_1
    return math.log(z) + at.log_d, z_k, 1.0 - l_1, z_kk - z_k * z_k, -l_1 * (first_end - z_k), l_2


def _proposed(total: Sequence[float], at: Channel, free_kappa: bool, free_d: bool) -> tuple[float, float]:
    """κ and log d after a damped step; as :func:`mkc_torch.density.likelihood.newton_proposal`."""
    chain = at.kappa + KAPPA_OFFSET
    g_s, g_l = total[1] * chain, total[2]
    h_ss, h_sl, h_ll = total[3] * chain**2, total[4] * chain, total[5]
    held_s = (at.kappa <= 0 and g_s > 0) or (at.kappa >= KAPPA_MAX and g_s < 0) or not free_kappa
    held_l = (at.log_d <= at.log_d_min and g_l > 0) or (at.log_d >= at.log_bound and g_l < 0) or not free_d
    if held_s:
        g_s, h_ss = 0.0, 1.0
    if held_l:
        g_l, h_ll = 0.0, 1.0
    if held_s or held_l:
        h_sl = 0.0
    least = 1e-8 * (abs(h_ss) + abs(h_ll))
    if not 0.0 < least < math.inf:
        return at.kappa, at.log_d
    r_s, r_l = 1.0 / math.sqrt(max(abs(h_ss), least)), 1.0 / math.sqrt(max(abs(h_ll), least))
    a, b, c = h_ss * r_s * r_s, h_sl * r_s * r_l, h_ll * r_l * r_l
    shift = max(math.hypot(0.5 * (a - c), b) - 0.5 * (a + c) + 1e-3, 0.0) + at.damping
    a, c = a + shift, c + shift
    determinant = a * c - b * b
    g_s, g_l = g_s * r_s, g_l * r_l
    step_s, step_l = r_s * (b * g_l - c * g_s) / determinant, r_l * (b * g_s - a * g_l) / determinant
    if not (math.isfinite(step_s) and math.isfinite(step_l)):
        return at.kappa, at.log_d
    shorten = LONGEST_STEP / max(abs(step_s), abs(step_l), LONGEST_STEP)
    kappa = min(max(chain * max(1.0 + shorten * step_s, LEAST_KAPPA_SHARE) - KAPPA_OFFSET, 0.0), KAPPA_MAX)
    log_d = min(max(at.log_d + shorten * step_l, at.log_d_min), at.log_bound)
    return kappa if free_kappa else at.kappa, log_d if free_d else at.log_d
