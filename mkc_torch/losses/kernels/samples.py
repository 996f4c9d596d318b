"""Pass over a batch with a bandwidth and a scale per element, normaliser included."""

from __future__ import annotations

import triton
import triton.language as tl

from mkc_torch.density.head_table import DEGREE, INTERVALS, RATE
from mkc_torch.losses.kernels.formulas import energy, energy_by_kappa


@triton.jit
def head_by_table(
    kappa, table, DEGREE: tl.constexpr = DEGREE, INTERVALS: tl.constexpr = INTERVALS, RATE: tl.constexpr = RATE
):  # fmt: skip
    """Integral over the head and its derivative in kappa, in float32, from mkc_torch.density.head_table."""
    place = tl.rsqrt(1.0 + RATE * kappa)
    position = place * INTERVALS
    index = tl.minimum(tl.maximum(position, 0.0), INTERVALS - 1.0).to(tl.int32)
    t = position - index.to(tl.float32) - 0.5
    value = tl.load(table + DEGREE * INTERVALS + index)
    slope = tl.zeros_like(value)
    for power in tl.static_range(DEGREE - 1, -1, -1):
        slope = slope * t + value
        value = value * t + tl.load(table + power * INTERVALS + index)
    return value, slope * (place * place * place) * (-0.5 * RATE * INTERVALS)


@triton.jit
def head_by_quadrature(
    kappa, inverse_kappa, tail, tail_slope, length, reach, rule, NODES: tl.constexpr, WIDE: tl.constexpr
):  # fmt: skip
    """Integral I over the head, dI/dkappa, and I - length dI/dlength."""
    end = tl.minimum(length, reach)
    integral, by_kappa = tl.zeros_like(kappa), tl.zeros_like(kappa)
    for node in range(NODES):
        u, share = end * tl.load(rule + node), end * tl.load(rule + NODES + node)
        value, _, minus_x, inlier, half = energy(u, kappa, inverse_kappa, WIDE)
        density = tl.exp(-value)
        integral += share * density
        by_kappa -= share * (energy_by_kappa(minus_x, inlier, half, inverse_kappa, WIDE) * density)
    integral, by_kappa = integral - 2.0 * end * tail, by_kappa - 2.0 * end * tail_slope
    at_end, _, _, _, _ = energy(length, kappa, inverse_kappa, WIDE)
    return integral, by_kappa, integral - 2.0 * length * (tl.exp(-at_end) - tail)


@triton.jit
def samples_kernel(
    x, t, sigma, d, w, upstream, bound, table, rule, total_weight,
    values, by_input, by_sigma, by_d, partial,
    count, inner, programs,
    CHANNELS: tl.constexpr, BLOCK: tl.constexpr, BOUND_EACH: tl.constexpr, HAS_WEIGHT: tl.constexpr, MEAN: tl.constexpr,
    UPSTREAM: tl.constexpr, WRITE_VALUES: tl.constexpr, WRITE_INPUT: tl.constexpr, WRITE_SIGMA: tl.constexpr,
    WRITE_D: tl.constexpr, SUMS: tl.constexpr, NODES: tl.constexpr, WIDE: tl.constexpr,
):  # fmt: skip
    """Values of elements (WRITE_VALUES), gradients of input, sigma and d, a summand of the value per program (SUMS).

    All tensors of elements are contiguous in the same layout. UPSTREAM: 0 if the upstream gradient is 1, 1 if it is a
    number, 2 if each element has its own. ``rule`` has NODES nodes of the quadrature, then their weights.
    """
    like = tl.float64 if WIDE else tl.float32
    lane = tl.arange(0, BLOCK)
    divisor = tl.full((), 1.0, like)
    if MEAN and HAS_WEIGHT:
        divisor = tl.load(total_weight).to(like)
        divisor = tl.where(divisor > 0, divisor, 1.0)
    elif MEAN:
        divisor = divisor * count
    factor = 1.0 / divisor
    if UPSTREAM == 1:
        factor = factor * tl.load(upstream).to(like)
    given_bound = tl.load(bound).to(like)
    sums = tl.zeros((BLOCK,), like)
    for block in range(tl.program_id(0), tl.cdiv(count, BLOCK), programs):
        start = tl.full((), BLOCK, tl.int64) * block
        place = start + lane
        mask = place < count
        error = tl.load(x + place, mask=mask, other=0.0).to(like) - tl.load(t + place, mask=mask, other=0.0).to(like)
        own_sigma = tl.load(sigma + place, mask=mask, other=1.0).to(like)
        own_d = tl.load(d + place, mask=mask, other=1.0).to(like)
        if BOUND_EACH:
            # within a cycle of the channels, because 32-bit division is faster
            round_of = inner * CHANNELS
            own = ((start % round_of).to(tl.int32) + lane) // inner % CHANNELS
            half_width = tl.load(bound + own).to(like)
        else:
            half_width = given_bound
        counts = mask
        if HAS_WEIGHT:
            weight = tl.load(w + place, mask=mask, other=0).to(like)
            counts = weight != 0
            error = tl.where(counts, error, 0.0)
            own_sigma = tl.where(counts, own_sigma, 1.0)
        own_d = tl.where(counts, own_d, half_width * 0.015625)  # masked elements: the head ends before the domain
        inverse_sigma, inverse_d = 1.0 / own_sigma, 1.0 / own_d
        kappa, square = inverse_sigma * inverse_sigma, own_sigma * own_sigma
        inverse_kappa = tl.where(kappa > 0, square, 1.0)
        z = error * inverse_d
        value, influence, minus_x, inlier, half = energy(z, kappa, inverse_kappa, WIDE)
        # the normaliser
        least = tl.minimum(square, 1000.0)
        tail = tl.exp(-square)
        tail_slope = tail * least * least
        length = half_width * inverse_d
        if WIDE:
            reach = tl.minimum(60.0 * square, tl.where(kappa < 0.01, 72.0, 540.0))
            head, head_slope, rest = head_by_quadrature(
                kappa, inverse_kappa, tail, tail_slope, length, tl.sqrt(reach), rule, NODES, WIDE
            )
        else:
            reach = tl.minimum(37.0 * square, tl.where(kappa < 0.03, 54.0, 220.0))
            head, head_slope = head_by_table(kappa, table)
            rest = head
            if tl.min(length * length - reach, 0) < 0.0:
                head, head_slope, rest = head_by_quadrature(
                    kappa, inverse_kappa, tail, tail_slope, length, tl.sqrt(reach), rule, NODES, WIDE
                )
        partition = 2.0 * half_width * tail + own_d * head
        if SUMS or WRITE_VALUES:
            value += tl.log(partition)
            if HAS_WEIGHT:
                value = value * weight
        if WRITE_VALUES:
            tl.store(values + place, value.to(values.dtype.element_ty), mask=mask)
        if SUMS:
            sums += tl.where(mask, value, 0.0)
        part = factor
        if HAS_WEIGHT:
            part = part * weight
        if UPSTREAM == 2:
            part = part * tl.load(upstream + place, mask=mask, other=0.0).to(like)
        inverse_partition = 1.0 / partition
        if WRITE_INPUT:
            slope = influence * inverse_d * part
            tl.store(by_input + place, slope.to(by_input.dtype.element_ty), mask=mask)
        if WRITE_SIGMA:
            # the square of half is finite, so that 0 times it is 0
            half = tl.minimum(half, 1e150 if WIDE else 1.8e19)
            slope = energy_by_kappa(minus_x, inlier, half, inverse_kappa, WIDE)
            slope += (2.0 * half_width * tail_slope + own_d * head_slope) * inverse_partition
            slope = slope * (-2.0 * kappa * inverse_sigma) * part
            tl.store(by_sigma + place, slope.to(by_sigma.dtype.element_ty), mask=mask)
        if WRITE_D:
            slope = (rest * inverse_partition - z * influence * inverse_d) * part
            tl.store(by_d + place, slope.to(by_d.dtype.element_ty), mask=mask)
    if SUMS:
        tl.store(partial + tl.program_id(0), tl.sum(sums, 0) / divisor)


@triton.jit
def rescale_samples_kernel(
    by_input, by_sigma, by_d, upstream, count, programs,
    BLOCK: tl.constexpr, HAS_INPUT: tl.constexpr, HAS_SIGMA: tl.constexpr, HAS_D: tl.constexpr,
):  # fmt: skip
    """Multiply stored gradients by the upstream gradient, in place; nothing is read if that is 1."""
    given = tl.load(upstream)
    if given != 1.0:
        for block in range(tl.program_id(0), tl.cdiv(count, BLOCK), programs):
            at = tl.full((), BLOCK, tl.int64) * block + tl.arange(0, BLOCK)
            mask = at < count
            if HAS_INPUT:
                found = tl.load(by_input + at, mask=mask, other=0.0).to(given.dtype) * given
                tl.store(by_input + at, found.to(by_input.dtype.element_ty), mask=mask)
            if HAS_SIGMA:
                found = tl.load(by_sigma + at, mask=mask, other=0.0).to(given.dtype) * given
                tl.store(by_sigma + at, found.to(by_sigma.dtype.element_ty), mask=mask)
            if HAS_D:
                found = tl.load(by_d + at, mask=mask, other=0.0).to(given.dtype) * given
                tl.store(by_d + at, found.to(by_d.dtype.element_ty), mask=mask)
