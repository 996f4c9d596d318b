"""A Newton step of the density's likelihood as a Triton function, for a kernel that holds a problem's residuals."""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def _energy_terms(q, kappa):
    """exp(-x), E, -∂E/∂κ and ∂²E/∂κ² at q = z²/2, x = κ q; as :func:`mkc_torch.density.energy.energy_terms`."""
    x = kappa * q
    w = tl.exp(-x)
    divisor = tl.where(kappa > 0, kappa, 1.0)
    qw = q * w
    # 1 - exp(-x) loses digits below this x
    series = 1.0 - x / 2.0 * (1.0 - x / 3.0 * (1.0 - x / 4.0 * (1.0 - x / 5.0 * (1.0 - x / 6.0 * (1.0 - x / 7.0)))))
    e = tl.where(x < 0.03, q * series, (1.0 - w) / divisor)
    first = (e - qw) / divisor
    second = (2.0 * first - q * qw) / divisor
    small = x < 1e-5
    first = tl.where(small, q * q * (0.5 - x / 3.0), first)
    second = tl.where(small, q * q * q * (1.0 / 3.0 - 0.25 * x), second)
    return w, e, first, second


@triton.jit
def _head(kappa, length, nodes, weights, TOLERANCE: tl.constexpr):
    """Nodes and weights on the head, as :func:`mkc_torch.density.head.head_rule`, and the density of the tail."""
    least = tl.maximum(kappa, 1e-3)
    end = 1.0 / least + tl.log(TOLERANCE + 0.0 * kappa)
    small = tl.exp(-tl.abs(end))
    softened = tl.where(small < 1e-5, small * (1.0 - small / 2.0), tl.log(1.0 + small))
    excess = least * (tl.maximum(end, 0.0) + softened)
    reach = tl.minimum(length, tl.sqrt(-2.0 * tl.log(excess) / least))
    tail = tl.where(kappa > 1e-3, tl.exp(-1.0 / least), 0.0)
    return reach * nodes, reach * weights, tail


@triton.jit
def _integral(values, tail, length, share):
    """As :func:`mkc_torch.density.head.integrate`.

    The condition is always true. Without it the compiler may fuse a lane's product with the sum of the other lanes, so
    that lanes differ in the last digit and leave a loop at different steps.
    """
    return 2.0 * length * tail + tl.sum(tl.where(share > 0, share * (values - tail), 0.0), 0)


@triton.jit
def _log_partition(kappa, length, nodes, weights, TOLERANCE: tl.constexpr):
    u, share, tail = _head(kappa, length, nodes, weights, TOLERANCE)
    _, e, _, _ = _energy_terms(0.5 * u * u, kappa)
    return tl.log(_integral(tl.exp(-e), tail, length, share))


@triton.jit
def newton_step(
    error, weight, kappa, log_d, log_bound, log_d_min, damping, nodes, weights, free_kappa, free_d,
    TOLERANCE: tl.constexpr, KAPPA_MAX: tl.constexpr, OFFSET: tl.constexpr, LONGEST: tl.constexpr,
    LEAST_SHARE: tl.constexpr,
):  # fmt: skip
    """κ, log d, damping and value after a step that never increases the value.

    As :func:`mkc_torch.density.likelihood.newton_step`. ``weight`` sums to 1; ``nodes`` and ``weights`` are the rule of
    the head.
    """
    z = error * tl.exp(-log_d)
    q = tl.minimum(0.5 * z * z, 1e100)
    w, e, first, second = _energy_terms(q, kappa)
    weighted_q = weight * q * w
    mean_qw, mean_q2w = tl.sum(weighted_q, 0), tl.sum(weighted_q * q, 0)
    value, by_kappa, by_log_d = tl.sum(weight * e, 0), -tl.sum(weight * first, 0), -2.0 * mean_qw
    twice_kappa, by_both = tl.sum(weight * second, 0), 2.0 * mean_q2w
    twice_log_d = 4.0 * (mean_qw - kappa * mean_q2w)

    length = tl.exp(log_bound - log_d)
    u, share, tail = _head(kappa, length, nodes, weights, TOLERANCE)
    k = tl.where(tail > 0, kappa, 1.0)
    tail_1, tail_2 = tail / (k * k), tail * (1.0 - 2.0 * k) / (k * k * k * k)
    _, head_e, head_1, head_2 = _energy_terms(0.5 * u * u, kappa)
    p = tl.exp(-head_e)
    partition = _integral(p, tail, length, share)
    z_k = _integral(head_1 * p, tail_1, length, share) / partition
    z_kk = _integral((head_1 * head_1 - head_2) * p, tail_2, length, share) / partition
    w_end, e_end, first_end, _ = _energy_terms(tl.minimum(0.5 * length * length, 1e100), kappa)
    edge = 2.0 * tl.exp(-e_end) / partition
    l_1 = length * edge
    value += tl.log(partition) + log_d
    by_kappa += z_k
    by_log_d += 1.0 - l_1
    twice_kappa += z_kk - z_k * z_k
    by_both += -l_1 * (first_end - z_k)
    twice_log_d += length * l_1 * (-length * w_end - edge) + l_1

    chain = kappa + OFFSET
    g_s, g_l, h_ss, h_sl, h_ll = by_kappa * chain, by_log_d, twice_kappa * chain * chain, by_both * chain, twice_log_d
    held_s = ((kappa <= 0) & (g_s > 0)) | ((kappa >= KAPPA_MAX) & (g_s < 0)) | (free_kappa == 0)
    held_l = ((log_d <= log_d_min) & (g_l > 0)) | ((log_d >= log_bound) & (g_l < 0)) | (free_d == 0)
    g_s, g_l = tl.where(held_s, 0.0, g_s), tl.where(held_l, 0.0, g_l)
    h_sl = tl.where(held_s | held_l, 0.0, h_sl)
    h_ss, h_ll = tl.where(held_s, 1.0, h_ss), tl.where(held_l, 1.0, h_ll)
    least = 1e-8 * (tl.abs(h_ss) + tl.abs(h_ll))
    r_s, r_l = 1.0 / tl.sqrt(tl.maximum(tl.abs(h_ss), least)), 1.0 / tl.sqrt(tl.maximum(tl.abs(h_ll), least))
    a, b, c = h_ss * r_s * r_s, h_sl * r_s * r_l, h_ll * r_l * r_l
    half = 0.5 * (a - c)
    shift = tl.maximum(tl.sqrt(half * half + b * b) - 0.5 * (a + c) + 1e-3, 0.0) + damping
    a, c = a + shift, c + shift
    determinant = a * c - b * b
    g_s, g_l = g_s * r_s, g_l * r_l
    step_s, step_l = r_s * (b * g_l - c * g_s) / determinant, r_l * (b * g_s - a * g_l) / determinant
    longest = tl.maximum(tl.abs(step_s), tl.abs(step_l))
    # comparisons with NaN are false
    usable = longest < float("inf")
    shorten = tl.where(usable, LONGEST / tl.maximum(longest, LONGEST), 0.0)
    step_s, step_l = tl.where(usable, step_s, 0.0), tl.where(usable, step_l, 0.0)
    grown = tl.maximum(1.0 + shorten * step_s, LEAST_SHARE)
    new_kappa = tl.minimum(tl.maximum(chain * grown - OFFSET, 0.0), KAPPA_MAX)
    new_kappa = tl.where(free_kappa > 0, new_kappa, kappa)
    new_log_d = tl.minimum(tl.maximum(log_d + shorten * step_l, log_d_min), log_bound)
    new_log_d = tl.where(free_d > 0, new_log_d, log_d)

    z = error * tl.exp(-new_log_d)
    _, e, _, _ = _energy_terms(tl.minimum(0.5 * z * z, 1e100), new_kappa)
    norm = _log_partition(new_kappa, tl.exp(log_bound - new_log_d), nodes, weights, TOLERANCE)
    proposed = tl.sum(weight * e, 0) + new_log_d + norm
    better = proposed <= value
    damped = tl.minimum(tl.maximum(tl.where(better, 0.1 * damping, 10.0 * damping), 1e-9), 1e6)
    return (
        tl.where(better, new_kappa, kappa),
        tl.where(better, new_log_d, log_d),
        damped,
        tl.where(better, proposed, value),
    )
