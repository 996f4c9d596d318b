"""One pass over a batch: values, gradients and the sums of each channel."""

from __future__ import annotations

import triton
import triton.language as tl

from mkc_torch.losses.kernels.formulas import energy, energy_by_kappa, initial

__all__ = ["elements_kernel", "finish_kernel", "rescale_kernel"]


@triton.jit
def finish(sum_network, sum_energy, sum_kappa, sum_d, weight, table, channel, mask, m, divisor,
           LEARN_KAPPA: tl.constexpr, LEARN_D: tl.constexpr, NORMALIZE: tl.constexpr, by_kappa, by_d):  # fmt: skip
    """The share of each channel in the value, and the stored gradients by the raw parameters."""
    total = sum_network + sum_energy
    if NORMALIZE:
        total += weight * tl.load(table + 4 * m + channel, mask=mask, other=0.0)
    if LEARN_KAPPA:
        if NORMALIZE:
            sum_kappa += weight * tl.load(table + 5 * m + channel, mask=mask, other=0.0)
        slope = tl.load(table + 2 * m + channel, mask=mask, other=0.0)
        tl.store(by_kappa + channel, sum_kappa * slope / divisor, mask=mask)
    if LEARN_D:
        sum_d = -sum_d / tl.load(table + m + channel, mask=mask, other=1.0)
        if NORMALIZE:
            sum_d += weight * tl.load(table + 6 * m + channel, mask=mask, other=0.0)
        slope = tl.load(table + 3 * m + channel, mask=mask, other=0.0)
        tl.store(by_d + channel, sum_d * slope / divisor, mask=mask)
    return total / divisor


@triton.jit
def elements_kernel(
    x, t, w, upstream, table, weights, total_weight,
    values, slopes, partial, value, by_kappa, by_d,
    outer, m, inner, so, sc, sk, wo, wc, wk, uo, uc, uk, programs, count,
    SO: tl.constexpr, BLOCK_ROW: tl.constexpr, BLOCK_COL: tl.constexpr, CHANNELS_LAST: tl.constexpr,
    HAS_WEIGHT: tl.constexpr, MEAN: tl.constexpr, UPSTREAM: tl.constexpr,
    ROBUST: tl.constexpr, LEARN_KAPPA: tl.constexpr, LEARN_D: tl.constexpr, NORMALIZE: tl.constexpr,
    WRITE_VALUES: tl.constexpr, WRITE_SLOPES: tl.constexpr, SUMS: tl.constexpr, FINISH: tl.constexpr,
    WIDE: tl.constexpr,
):  # fmt: skip
    """Values of elements (WRITE_VALUES), gradients by the input (WRITE_SLOPES) and sums of each channel (SUMS).

    UPSTREAM is 0 where the upstream gradient is 1, 1 where it is one number and 2 where each element has its own. The
    tile is rows by channels (CHANNELS_LAST) or rows by places within a channel. With FINISH the one program that there
    is makes the value and the gradients by the raw parameters itself.
    """
    like = tl.float64 if WIDE else tl.float32
    lane = tl.arange(0, BLOCK_COL)
    if CHANNELS_LAST:
        channel = tl.program_id(1) * BLOCK_COL + lane
        known = channel < m
        blocks_col = 1
    else:
        channel = tl.program_id(1) + 0 * lane
        known = lane >= 0
        blocks_col = tl.cdiv(inner, BLOCK_COL)
    kappa = tl.load(table + channel, mask=known, other=1.0)[None, :]
    d = tl.load(table + m + channel, mask=known, other=1.0)[None, :]
    if ROBUST:
        annealed_kappa = tl.load(table + 7 * m + channel, mask=known, other=1.0)[None, :]
        annealed_d = tl.load(table + 8 * m + channel, mask=known, other=1.0)[None, :]
        scale = tl.load(table + 9 * m + channel, mask=known, other=1.0)[None, :]
        share = tl.load(table + 10 * m + channel, mask=known, other=1.0)[None, :]
        of_annealed, of_initial = share / annealed_d, (1.0 - share) / scale
    if NORMALIZE and WRITE_VALUES:
        norm = tl.load(table + 4 * m + channel, mask=known, other=0.0)[None, :]
    divisor = tl.full((), 1.0, like) * count
    if HAS_WEIGHT and MEAN:
        divisor = tl.load(total_weight).to(like)
        divisor = tl.where(divisor > 0, divisor, 1.0)
    factor = 1.0 / divisor
    if UPSTREAM == 1:
        factor = factor * tl.load(upstream).to(like)
    sum_energy = tl.zeros((BLOCK_ROW, BLOCK_COL), like)
    sum_network = tl.zeros((BLOCK_ROW, BLOCK_COL), like)
    sum_kappa = tl.zeros((BLOCK_ROW, BLOCK_COL), like)
    sum_d = tl.zeros((BLOCK_ROW, BLOCK_COL), like)
    sum_weight = tl.zeros((BLOCK_ROW, BLOCK_COL), like)
    blocks = tl.cdiv(outer, BLOCK_ROW) * blocks_col
    for block in range(tl.program_id(0), blocks, programs):
        block_row = block // blocks_col
        row = (tl.full((), BLOCK_ROW, tl.int64) * block_row + tl.arange(0, BLOCK_ROW))[:, None]
        if CHANNELS_LAST:
            mask = (row < outer) & known[None, :]
            place = row * SO + (channel * sc)[None, :]
        else:
            k = (tl.full((), BLOCK_COL, tl.int64) * (block - block_row * blocks_col) + lane)[None, :]
            mask = (row < outer) & (k < inner)
            place = row * so + (channel.to(tl.int64) * sc)[None, :] + k * sk
        error = tl.load(x + place, mask=mask, other=0.0).to(like) - tl.load(t + place, mask=mask, other=0.0).to(like)
        factors = factor
        if HAS_WEIGHT:
            if CHANNELS_LAST:
                weight = tl.load(w + row * wo + (channel * wc)[None, :], mask=mask, other=0).to(like)
            else:
                weight = tl.load(w + row * wo + (channel * wc)[None, :] + k * wk, mask=mask, other=0).to(like)
            error = tl.where(weight != 0, error, 0.0)
            factors = factors * weight
        if UPSTREAM == 2:
            if CHANNELS_LAST:
                given = tl.load(upstream + row * uo + (channel * uc)[None, :], mask=mask, other=0.0).to(like)
            else:
                given = tl.load(upstream + row * uo + (channel * uc)[None, :] + k * uk, mask=mask, other=0.0).to(like)
            factors = factors * given
        z = error / d
        density, slope = energy(z, kappa)
        network = 0.0
        if ROBUST:
            own, own_slope = energy(error / annealed_d, annealed_kappa)
            first, first_slope = initial(error / scale)
            network = share * own + (1.0 - share) * first
            by_input = own_slope * of_annealed + first_slope * of_initial
        else:
            by_input = slope / d
        if WRITE_SLOPES:
            tl.store(slopes + place, (by_input * factors).to(slopes.dtype.element_ty), mask=mask)
        if WRITE_VALUES:
            written = network + density
            if NORMALIZE:
                written += norm
            if HAS_WEIGHT:
                written = written * weight
            tl.store(values + place, written.to(values.dtype.element_ty), mask=mask)
        if SUMS:
            # weights of the sums: upstream gradients without the divisor, which finish() has
            if HAS_WEIGHT:
                part = weight
                if UPSTREAM == 2:
                    part = part * given
                density, network, slope = density * part, network * part, slope * part
            elif UPSTREAM == 2:
                part = given
                density, network, slope = density * part, network * part, slope * part
            sum_energy += density
            if ROBUST:
                sum_network += network
            if LEARN_D:
                sum_d += tl.where(mask, z * slope, 0.0)
            if LEARN_KAPPA:
                curve = energy_by_kappa(z, kappa)
                if HAS_WEIGHT or UPSTREAM == 2:
                    curve = curve * part
                sum_kappa += curve
            if UPSTREAM == 2:
                sum_weight += part
    if SUMS:
        total_energy, total_network = tl.sum(sum_energy, 0), tl.sum(sum_network, 0)
        total_kappa, total_d, total_given = tl.sum(sum_kappa, 0), tl.sum(sum_d, 0), tl.sum(sum_weight, 0)
        if not CHANNELS_LAST:  # the one channel of this program, in the first lane
            total_energy = tl.where(lane == 0, tl.sum(total_energy, 0), 0.0)
            total_network = tl.where(lane == 0, tl.sum(total_network, 0), 0.0)
            total_kappa = tl.where(lane == 0, tl.sum(total_kappa, 0), 0.0)
            total_d = tl.where(lane == 0, tl.sum(total_d, 0), 0.0)
            total_given = tl.where(lane == 0, tl.sum(total_given, 0), 0.0)
            known = lane == 0
        if FINISH:
            each = tl.full((), 1.0, like) * outer * inner
            if UPSTREAM == 2:
                each = total_given
            elif HAS_WEIGHT:
                each = tl.load(weights + channel, mask=known, other=0.0).to(like)
            part_of_value = finish(
                total_network, total_energy, total_kappa, total_d, each, table, channel, known, m, divisor,
                LEARN_KAPPA, LEARN_D, NORMALIZE, by_kappa, by_d,
            )  # fmt: skip
            tl.store(value, tl.sum(tl.where(known, part_of_value, 0.0), 0))
        else:
            at = partial + tl.program_id(0) * m + channel
            step = programs * m
            tl.store(at, total_energy, mask=known)
            if ROBUST:
                tl.store(at + step, total_network, mask=known)
            if LEARN_KAPPA:
                tl.store(at + 2 * step, total_kappa, mask=known)
            if LEARN_D:
                tl.store(at + 3 * step, total_d, mask=known)
            if UPSTREAM == 2:
                tl.store(at + 4 * step, total_given, mask=known)


@triton.jit
def finish_kernel(
    partial, table, weights, total_weight, value, by_kappa, by_d, m, programs, each_weight, count,
    BLOCK_ROW: tl.constexpr, BLOCK_COL: tl.constexpr, HAS_WEIGHT: tl.constexpr, MEAN: tl.constexpr,
    ROBUST: tl.constexpr, LEARN_KAPPA: tl.constexpr, LEARN_D: tl.constexpr, NORMALIZE: tl.constexpr,
    GIVEN: tl.constexpr, WIDE: tl.constexpr,
):  # fmt: skip
    """Add up the sums of all programs in a fixed order, and finish; ``value`` gets a share for each program."""
    like = tl.float64 if WIDE else tl.float32
    channel = tl.program_id(0) * BLOCK_COL + tl.arange(0, BLOCK_COL)
    known = channel < m
    step = programs * m
    sum_energy = tl.zeros((BLOCK_ROW, BLOCK_COL), tl.float64)
    sum_network = tl.zeros((BLOCK_ROW, BLOCK_COL), tl.float64)
    sum_kappa = tl.zeros((BLOCK_ROW, BLOCK_COL), tl.float64)
    sum_d = tl.zeros((BLOCK_ROW, BLOCK_COL), tl.float64)
    sum_given = tl.zeros((BLOCK_ROW, BLOCK_COL), tl.float64)
    for first in range(0, programs, BLOCK_ROW):
        row = first + tl.arange(0, BLOCK_ROW)[:, None]
        at = partial + row * m + channel[None, :]
        mask = (row < programs) & known[None, :]
        sum_energy += tl.load(at, mask=mask, other=0.0).to(tl.float64)
        if ROBUST:
            sum_network += tl.load(at + step, mask=mask, other=0.0).to(tl.float64)
        if LEARN_KAPPA:
            sum_kappa += tl.load(at + 2 * step, mask=mask, other=0.0).to(tl.float64)
        if LEARN_D:
            sum_d += tl.load(at + 3 * step, mask=mask, other=0.0).to(tl.float64)
        if GIVEN:
            sum_given += tl.load(at + 4 * step, mask=mask, other=0.0).to(tl.float64)
    divisor = tl.full((), 1.0, like) * count
    if HAS_WEIGHT and MEAN:
        divisor = tl.load(total_weight).to(like)
        divisor = tl.where(divisor > 0, divisor, 1.0)
    if GIVEN:
        each = tl.sum(sum_given, 0).to(like)
    elif HAS_WEIGHT:
        each = tl.load(weights + channel, mask=known, other=0.0).to(like)
    else:
        each = tl.full((), 1.0, like) * each_weight
    found = finish(
        tl.sum(sum_network, 0).to(like), tl.sum(sum_energy, 0).to(like), tl.sum(sum_kappa, 0).to(like),
        tl.sum(sum_d, 0).to(like), each, table, channel, known, m, divisor,
        LEARN_KAPPA, LEARN_D, NORMALIZE, by_kappa, by_d,
    )  # fmt: skip
    tl.store(value + tl.program_id(0), tl.sum(tl.where(known, found, 0.0), 0))


@triton.jit
def rescale_kernel(
    slopes, by_kappa, by_d, upstream, count, m, programs,
    BLOCK: tl.constexpr, HAS_SLOPES: tl.constexpr, LEARN_KAPPA: tl.constexpr, LEARN_D: tl.constexpr,
):  # fmt: skip
    """Multiply stored gradients by the upstream gradient, in place; where that is 1 nothing is read."""
    given = tl.load(upstream)
    if given != 1.0:
        if HAS_SLOPES:
            for block in range(tl.program_id(0), tl.cdiv(count, BLOCK), programs):
                at = tl.full((), BLOCK, tl.int64) * block + tl.arange(0, BLOCK)
                mask = at < count
                found = tl.load(slopes + at, mask=mask, other=0.0).to(given.dtype)
                tl.store(slopes + at, (found * given).to(slopes.dtype.element_ty), mask=mask)
        if tl.program_id(0) == 0:
            for first in range(0, m, BLOCK):
                at = first + tl.arange(0, BLOCK)
                mask = at < m
                if LEARN_KAPPA:
                    tl.store(by_kappa + at, tl.load(by_kappa + at, mask=mask, other=0.0) * given, mask=mask)
                if LEARN_D:
                    tl.store(by_d + at, tl.load(by_d + at, mask=mask, other=0.0) * given, mask=mask)
