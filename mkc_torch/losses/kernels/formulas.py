"""Triton functions that the loss's kernels share: energy of an element, and log Z of a channel, with derivatives."""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def series(minus_x, WIDE: tl.constexpr):
    """``(1 - exp(-x)) / x`` for 0 <= x <= 0.25, accurate to float32 or, with WIDE, to float64."""
    if WIDE:
        value = 1.0 / 39916800 + minus_x * (1.0 / 479001600)
        value = 1.0 / 3628800 + minus_x * value
        value = 1.0 / 362880 + minus_x * value
        value = 1.0 / 40320 + minus_x * value
        value = 1.0 / 5040 + minus_x * value
        value = 1.0 / 720 + minus_x * value
    else:
        value = 1.0 / 720
    value = 1.0 / 120 + minus_x * value
    value = 1.0 / 24 + minus_x * value
    value = 1.0 / 6 + minus_x * value
    value = 0.5 + minus_x * value
    return 1.0 + minus_x * value


@triton.jit
def curve_series(minus_x, WIDE: tl.constexpr):
    """``(1 - exp(-x) (1 + x)) / x²``, the sum of ``(-x)^n / (n! (n + 2))``, for 0 <= x <= 0.5."""
    if WIDE:
        value = 1.0 / (362880.0 * 11.0) + minus_x * (1.0 / (3628800.0 * 12.0))
        value = 1.0 / (40320.0 * 10.0) + minus_x * value
        value = 1.0 / (5040.0 * 9.0) + minus_x * value
        value = 1.0 / (720.0 * 8.0) + minus_x * value
    else:
        value = 1.0 / (720.0 * 8.0)
    value = 1.0 / (120.0 * 7.0) + minus_x * value
    value = 1.0 / (24.0 * 6.0) + minus_x * value
    value = 1.0 / (6.0 * 5.0) + minus_x * value
    value = 1.0 / (2.0 * 4.0) + minus_x * value
    value = 1.0 / 3.0 + minus_x * value
    return 0.5 + minus_x * value


@triton.jit
def energy(z, kappa, inverse_kappa, WIDE: tl.constexpr):
    """Energy of a standardised error z, its derivative with respect to z, -x = -kappa z² / 2, exp(-x) and z² / 2.

    ``inverse_kappa`` may be any finite number where kappa is 0.
    """
    minus_x = (z * (-0.5 * kappa)) * z  # this order gives 0 at kappa = 0, even where z² overflows
    inlier = tl.exp(minus_x)
    half = (0.5 * z) * z
    near = half * series(tl.maximum(minus_x, -0.25), WIDE)
    value = tl.where(minus_x > -0.25, near, inverse_kappa - inverse_kappa * inlier)
    return value, z * inlier, minus_x, inlier, half


@triton.jit
def energy_by_kappa(minus_x, inlier, half, inverse_kappa, WIDE: tl.constexpr):
    """Derivative of the energy with respect to kappa, from the results of :func:`energy`."""
    near = -half * half * curve_series(tl.maximum(minus_x, -0.5), WIDE)
    far = (inlier * (1.0 - tl.maximum(minus_x, -1e4)) - 1.0) * (inverse_kappa * inverse_kappa)
    return tl.where(minus_x > -0.5, near, far)


@triton.jit
def initial(z, WIDE: tl.constexpr):
    """The initial loss, with sharpness 0.2 scales, and its derivative."""
    ratio = z * 5.0
    if WIDE:
        root = tl.sqrt(1.0 + ratio * ratio)
        fourth = tl.sqrt(root)
        slope = z / (root * fourth)
    else:
        square = tl.minimum(1.0 + ratio * ratio, 1e37)
        inverse = tl.rsqrt(square)
        root = square * inverse
        inverse_fourth = tl.rsqrt(root)
        fourth = root * inverse_fourth
        slope = z * (inverse * inverse_fourth)
    return 0.08 * (fourth - 1.0), slope


@triton.jit
def log_partition(kappa, length, rule, NODES: tl.constexpr):
    """``log Z`` of a channel and its derivatives with respect to kappa and length, all in float64.

    ``rule`` has NODES nodes on [0, 1], then their weights: those of mkc_torch.density.normalizer.
    """
    lane = tl.arange(0, NODES)
    nodes, weights = tl.load(rule + lane), tl.load(rule + NODES + lane)
    positive = kappa > 1e-3
    safe = tl.where(positive, kappa, 1.0)
    tail = tl.where(positive, tl.exp(-1.0 / safe), 0.0)
    least = tl.maximum(kappa, 1e-3)
    above = 1.0 / least - 29.933606208922594  # the logarithm of 1e-13
    softplus = tl.where(above > 30.0, above, tl.log(1.0 + tl.exp(tl.minimum(above, 30.0))))
    reach = tl.sqrt(-2.0 * tl.log(least * softplus) / least)
    end = tl.minimum(length, reach)
    u = end * nodes
    inverse = 1.0 / tl.where(kappa > 0, kappa, 1.0)
    value, _, minus_x, inlier, half = energy(u, kappa, inverse, True)
    density = tl.exp(-value)
    share = end * weights
    tail_slope = tail / (safe * safe)
    z = 2.0 * length * tail + tl.sum(share * (density - tail), 0)
    by_kappa = 2.0 * length * tail_slope + tl.sum(
        share * (-energy_by_kappa(minus_x, inlier, half, inverse, True) * density - tail_slope), 0
    )
    at_end, _, _, _, _ = energy(length, kappa, inverse, True)
    return tl.log(z), by_kappa / z, 2.0 * tl.exp(-at_end) / z
