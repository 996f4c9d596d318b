"""What the kernels compute of an element and of a channel, as Triton functions."""

from __future__ import annotations

import triton
import triton.language as tl

__all__ = ["energy", "energy_by_kappa", "initial", "log_partition"]


@triton.jit
def series(x, KIND: tl.constexpr):
    """``(1 - exp(-x)) / x`` (KIND 0) or ``(1 - exp(-x) (1 + x)) / x²`` (KIND 1), for 0 <= x <= 0.5."""
    if KIND == 0:
        value = 1.0 - x * (1.0 / 12)
        value = 1.0 - x * (1.0 / 11) * value
        value = 1.0 - x * (1.0 / 10) * value
        value = 1.0 - x * (1.0 / 9) * value
        value = 1.0 - x * (1.0 / 8) * value
        value = 1.0 - x * (1.0 / 7) * value
        value = 1.0 - x * (1.0 / 6) * value
        value = 1.0 - x * (1.0 / 5) * value
        value = 1.0 - x * (1.0 / 4) * value
        value = 1.0 - x * (1.0 / 3) * value
        return 1.0 - x * (1.0 / 2) * value
    # coefficients (-1)^n / (n! (n + 2))
    value = 1.0 / (3628800.0 * 12.0)
    value = -1.0 / (362880.0 * 11.0) + x * value
    value = 1.0 / (40320.0 * 10.0) + x * value
    value = -1.0 / (5040.0 * 9.0) + x * value
    value = 1.0 / (720.0 * 8.0) + x * value
    value = -1.0 / (120.0 * 7.0) + x * value
    value = 1.0 / (24.0 * 6.0) + x * value
    value = -1.0 / (6.0 * 5.0) + x * value
    value = 1.0 / (2.0 * 4.0) + x * value
    value = -1.0 / 3.0 + x * value
    return 0.5 + x * value


@triton.jit
def energy(z, kappa):
    """Energy of a standardised error, and its derivative by it."""
    minus_x = tl.maximum((z * (-0.5 * kappa)) * z, -1e4)  # in this order 0 times a square that overflows is 0
    inlier = tl.exp(minus_x)
    near = 0.5 * z * z * series(tl.minimum(-minus_x, 0.5), 0)
    far = (1.0 - inlier) / tl.where(kappa > 0, kappa, 1.0)
    value = tl.where(minus_x > -0.5, near, far)
    return tl.where(z == z, value, z), z * inlier  # the maximum of NaN and a number is the number


@triton.jit
def energy_by_kappa(z, kappa):
    """Derivative of the energy by kappa."""
    minus_x = tl.maximum((z * (-0.5 * kappa)) * z, -1e4)
    half = 0.5 * z * z
    near = -half * half * series(tl.minimum(-minus_x, 0.5), 1)
    positive = tl.where(kappa > 0, kappa, 1.0)
    far = (tl.exp(minus_x) * (1.0 - minus_x) - 1.0) / (positive * positive)
    return tl.where(minus_x > -0.5, near, far)


@triton.jit
def initial(z):
    """The initial loss, which bends at 0.2 scales, and its derivative."""
    ratio = z * 5.0
    root = tl.sqrt(1.0 + ratio * ratio)
    fourth = tl.sqrt(root)
    return 0.08 * (fourth - 1.0), z / (root * fourth)


@triton.jit
def log_partition(kappa, length, rule, NODES: tl.constexpr):
    """``log Z`` of one channel and its derivatives by kappa and by length, all in float64.

    ``rule`` has NODES nodes on [0, 1] and then as many weights: those of mkc_torch.density.normalizer.
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
    value, _ = energy(u, kappa)
    density = tl.exp(-value)
    share = end * weights
    tail_slope = tail / (safe * safe)
    z = 2.0 * length * tail + tl.sum(share * (density - tail), 0)
    by_kappa = 2.0 * length * tail_slope + tl.sum(share * (-energy_by_kappa(u, kappa) * density - tail_slope), 0)
    at_end, _ = energy(length, kappa)
    return tl.log(z), by_kappa / z, 2.0 * tl.exp(-at_end) / z
