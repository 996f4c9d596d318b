"""Pass over a batch: values, gradients and the sums of each channel."""

from __future__ import annotations

import triton
import triton.language as tl

from mkc_torch.losses.kernels.formulas import energy, energy_by_kappa, initial


@triton.jit
def finish(sum_network, sum_energy, sum_kappa, sum_d, weight, table, channel, mask, m, divisor,
           LEARN_KAPPA: tl.constexpr, LEARN_D: tl.constexpr, NORMALIZE: tl.constexpr, by_kappa, by_d):  # fmt: skip
    """Contribution of each channel to the value; stores the gradients with respect to the raw parameters."""
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
def walk(
    x, t, w, upstream, values, slopes, table,
    outer, inner, so, sc, sk, wo, wc, wk, uo, uc, uk, programs, elements, factor,
    CHANNELS: tl.constexpr, BLOCK_ROW: tl.constexpr, BLOCK_COL: tl.constexpr, LAYOUT: tl.constexpr,
    HAS_WEIGHT: tl.constexpr, EACH: tl.constexpr, ANNEALED: tl.constexpr, INITIAL: tl.constexpr,
    CURVE: tl.constexpr, LEARN_KAPPA: tl.constexpr, LEARN_D: tl.constexpr, NORMALIZE: tl.constexpr,
    WRITE_VALUES: tl.constexpr, WRITE_SLOPES: tl.constexpr, SUMS: tl.constexpr, WIDE: tl.constexpr,
):  # fmt: skip
    """The pass of a program. ANNEALED, INITIAL: whether that loss is used in this phase; the likelihood has neither.

    Returns, for each place of the tile, the sums of the network term, of the energy, of the energy's derivative with
    respect to kappa, of -d times its derivative with respect to d, and of the upstream gradients. With CURVE the
    derivative with respect to kappa is summed over elements; without CURVE it is computed from the other sums, which is
    accurate unless a kappa is small.
    """
    like = tl.float64 if WIDE else tl.float32
    m: tl.constexpr = CHANNELS
    lane = tl.arange(0, BLOCK_COL)
    rows = tl.arange(0, BLOCK_ROW)
    if LAYOUT == 0:
        channel = tl.program_id(1) + 0 * lane
        blocks_col = tl.cdiv(inner, BLOCK_COL)
        tile = rows.to(tl.int64)[:, None] * so + (lane * sk)[None, :]
        tile_w = rows.to(tl.int64)[:, None] * wo + (lane * wk)[None, :]
        tile_u = rows.to(tl.int64)[:, None] * uo + (lane * uk)[None, :]
        channel_place = tl.full((), 1, tl.int64) * tl.program_id(1)
        known = lane >= 0
    elif LAYOUT == 1:
        channel = tl.program_id(1) * BLOCK_COL + lane
        blocks_col = 1
        tile = rows[:, None] * CHANNELS + channel[None, :]
        tile_w = rows[:, None] * wo + (channel * wc)[None, :]
        tile_u = rows[:, None] * uo + (channel * uc)[None, :]
        known = channel < CHANNELS
    else:
        channel = lane % CHANNELS
        blocks_col = 1
        together: tl.constexpr = BLOCK_COL // CHANNELS
        tile = rows[:, None] * BLOCK_COL + lane[None, :]
        row_of = rows[:, None] * together + (lane // CHANNELS)[None, :]
        tile_w = row_of * wo + (channel * wc)[None, :]
        tile_u = row_of * uo + (channel * uc)[None, :]
        known = lane >= 0
    kappa = tl.load(table + channel, mask=known, other=1.0)[None, :]
    inverse_d = 1.0 / tl.load(table + m + channel, mask=known, other=1.0)[None, :]
    inverse_kappa = 1.0 / tl.where(kappa > 0, kappa, 1.0)
    if ANNEALED:
        annealed_kappa = tl.load(table + 7 * m + channel, mask=known, other=1.0)[None, :]
        inverse_annealed = 1.0 / tl.where(annealed_kappa > 0, annealed_kappa, 1.0)
        inverse_annealed_d = 1.0 / tl.load(table + 8 * m + channel, mask=known, other=1.0)[None, :]
        of_annealed = inverse_annealed_d * factor
    if INITIAL:
        inverse_scale = 1.0 / tl.load(table + 9 * m + channel, mask=known, other=1.0)[None, :]
        of_initial = inverse_scale * factor
    if ANNEALED and INITIAL:
        share = tl.load(table + 10 * m + channel, mask=known, other=0.0)[None, :]
        of_annealed, of_initial = of_annealed * share, of_initial * (1.0 - share)
    of_density = inverse_d * factor
    if NORMALIZE and WRITE_VALUES:
        norm = tl.load(table + 4 * m + channel, mask=known, other=0.0)[None, :]
    sum_network = tl.zeros((BLOCK_ROW, BLOCK_COL), like)
    sum_energy = tl.zeros((BLOCK_ROW, BLOCK_COL), like)
    sum_kappa = tl.zeros((BLOCK_ROW, BLOCK_COL), like)
    sum_d = tl.zeros((BLOCK_ROW, BLOCK_COL), like)
    sum_weight = tl.zeros((BLOCK_ROW, BLOCK_COL), like)
    blocks = tl.cdiv(outer, BLOCK_ROW) * blocks_col
    for block in range(tl.program_id(0), blocks, programs):
        block_row = block // blocks_col
        first_row = tl.full((), BLOCK_ROW, tl.int64) * block_row
        if LAYOUT == 0:
            first_k = tl.full((), BLOCK_COL, tl.int64) * (block - block_row * blocks_col)
            mask = (rows[:, None] < outer - first_row) & (lane[None, :] < inner - first_k)
            place = first_row * so + channel_place * sc + first_k * sk + tile
            place_w = first_row * wo + channel_place * wc + first_k * wk + tile_w
            place_u = first_row * uo + channel_place * uc + first_k * uk + tile_u
        elif LAYOUT == 1:
            mask = (rows[:, None] < outer - first_row) & known[None, :]
            place = first_row * CHANNELS + tile
            place_w, place_u = first_row * wo + tile_w, first_row * uo + tile_u
        else:
            place = first_row * BLOCK_COL + tile
            mask = place < elements
            place_w, place_u = first_row * together * wo + tile_w, first_row * together * uo + tile_u
        error = tl.load(x + place, mask=mask, other=0.0).to(like) - tl.load(t + place, mask=mask, other=0.0).to(like)
        if HAS_WEIGHT:
            weight = tl.load(w + place_w, mask=mask, other=0).to(like)
            error = tl.where(weight != 0, error, 0.0)
        if EACH:
            given = tl.load(upstream + place_u, mask=mask, other=0.0).to(like)
        z = error * inverse_d
        density, slope, minus_x, inlier, half = energy(z, kappa, inverse_kappa, WIDE)
        written = density
        if ANNEALED:
            network, own_slope, _, _, _ = energy(error * inverse_annealed_d, annealed_kappa, inverse_annealed, WIDE)
            by_input = of_annealed * own_slope
        if INITIAL:
            first, first_slope = initial(error * inverse_scale, WIDE)
            if ANNEALED:
                network = first + share * (network - first)
                by_input += of_initial * first_slope
            else:
                network, by_input = first, of_initial * first_slope
        if ANNEALED or INITIAL:
            written += network
        else:
            by_input = slope * of_density
        if WRITE_SLOPES:
            if HAS_WEIGHT:
                by_input = by_input * weight
            if EACH:
                by_input = by_input * given
            tl.store(slopes + place, by_input.to(slopes.dtype.element_ty), mask=mask)
        if WRITE_VALUES:
            if NORMALIZE:
                written += norm
            if HAS_WEIGHT:
                written = written * weight
            tl.store(values + place, written.to(values.dtype.element_ty), mask=mask)
        if SUMS:
            if LEARN_KAPPA and CURVE:
                curve = energy_by_kappa(minus_x, inlier, half, inverse_kappa, WIDE)
            # the upstream gradient of each element; finish() applies the divisor
            if HAS_WEIGHT and EACH:
                part = weight * given
            elif HAS_WEIGHT:
                part = weight
            elif EACH:
                part = given
            if HAS_WEIGHT or EACH:
                density, slope = density * part, slope * part
                if ANNEALED or INITIAL:
                    network = network * part
                if LEARN_KAPPA and CURVE:
                    curve = curve * part
            sum_energy += density
            if ANNEALED or INITIAL:
                sum_network += network
            if LEARN_D or (LEARN_KAPPA and not CURVE):
                sum_d += z * slope
            if LEARN_KAPPA and CURVE:
                sum_kappa += curve
            if EACH:
                sum_weight += part
    if SUMS and LEARN_KAPPA and not CURVE:
        sum_kappa = (0.5 * sum_d - sum_energy) * inverse_kappa
    return sum_network, sum_energy, sum_kappa, sum_d, sum_weight


@triton.jit
def walk_by_kappa(
    least_kappa, x, t, w, upstream, values, slopes, table,
    outer, inner, so, sc, sk, wo, wc, wk, uo, uc, uk, programs, elements, factor,
    CHANNELS: tl.constexpr, BLOCK_ROW: tl.constexpr, BLOCK_COL: tl.constexpr, LAYOUT: tl.constexpr,
    HAS_WEIGHT: tl.constexpr, EACH: tl.constexpr, ANNEALED: tl.constexpr, INITIAL: tl.constexpr,
    LEARN_KAPPA: tl.constexpr, LEARN_D: tl.constexpr, NORMALIZE: tl.constexpr,
    WRITE_VALUES: tl.constexpr, WRITE_SLOPES: tl.constexpr, SUMS: tl.constexpr, WIDE: tl.constexpr,
):  # fmt: skip
    """:func:`walk`; sums the derivative with respect to kappa, a third of the work, only if a kappa is small."""
    if LEARN_KAPPA and SUMS and not WIDE:
        if least_kappa >= 0.1:
            sum_network, sum_energy, sum_kappa, sum_d, sum_weight = walk(
                x, t, w, upstream, values, slopes, table, outer, inner, so, sc, sk, wo, wc, wk, uo, uc, uk, programs,
                elements, factor, CHANNELS, BLOCK_ROW, BLOCK_COL, LAYOUT, HAS_WEIGHT, EACH, ANNEALED, INITIAL, False,
                LEARN_KAPPA, LEARN_D, NORMALIZE, WRITE_VALUES, WRITE_SLOPES, SUMS, WIDE,
            )  # fmt: skip
        else:
            sum_network, sum_energy, sum_kappa, sum_d, sum_weight = walk(
                x, t, w, upstream, values, slopes, table, outer, inner, so, sc, sk, wo, wc, wk, uo, uc, uk, programs,
                elements, factor, CHANNELS, BLOCK_ROW, BLOCK_COL, LAYOUT, HAS_WEIGHT, EACH, ANNEALED, INITIAL, True,
                LEARN_KAPPA, LEARN_D, NORMALIZE, WRITE_VALUES, WRITE_SLOPES, SUMS, WIDE,
            )  # fmt: skip
    else:
        sum_network, sum_energy, sum_kappa, sum_d, sum_weight = walk(
            x, t, w, upstream, values, slopes, table, outer, inner, so, sc, sk, wo, wc, wk, uo, uc, uk, programs,
            elements, factor, CHANNELS, BLOCK_ROW, BLOCK_COL, LAYOUT, HAS_WEIGHT, EACH, ANNEALED, INITIAL, True,
            LEARN_KAPPA, LEARN_D, NORMALIZE, WRITE_VALUES, WRITE_SLOPES, SUMS, WIDE,
        )  # fmt: skip
    return sum_network, sum_energy, sum_kappa, sum_d, sum_weight


@triton.jit
def elements_kernel(
    x, t, w, upstream, table, weights, total_weight,
    values, slopes, partial, value, by_kappa, by_d,
    outer, inner, so, sc, sk, wo, wc, wk, uo, uc, uk, programs, count, elements,
    CHANNELS: tl.constexpr, BLOCK_ROW: tl.constexpr, BLOCK_COL: tl.constexpr, LAYOUT: tl.constexpr,
    HAS_WEIGHT: tl.constexpr, MEAN: tl.constexpr, UPSTREAM: tl.constexpr,
    ROBUST: tl.constexpr, LEARN_KAPPA: tl.constexpr, LEARN_D: tl.constexpr, NORMALIZE: tl.constexpr,
    WRITE_VALUES: tl.constexpr, WRITE_SLOPES: tl.constexpr, SUMS: tl.constexpr, FINISH: tl.constexpr,
    WIDE: tl.constexpr,
):  # fmt: skip
    """Values of elements (WRITE_VALUES), gradients of the input (WRITE_SLOPES) and sums of each channel (SUMS).

    UPSTREAM: 0 if the upstream gradient is 1, 1 if it is a number, 2 if each element has its own. LAYOUT of a tile's
    columns: 0, places within the single channel of a program; 1, channels; 2, channels of successive rows in contiguous
    memory. With FINISH a single program also computes the value and the gradients with respect to the raw parameters.
    """
    like = tl.float64 if WIDE else tl.float32
    m: tl.constexpr = CHANNELS
    each: tl.constexpr = UPSTREAM == 2
    lane = tl.arange(0, BLOCK_COL)
    divisor = tl.full((), 1.0, like) * count
    if HAS_WEIGHT and MEAN:
        divisor = tl.load(total_weight).to(like)
        divisor = tl.where(divisor > 0, divisor, 1.0)
    factor = 1.0 / divisor
    if UPSTREAM == 1:
        factor = factor * tl.load(upstream).to(like)
    if LAYOUT == 0:
        channel = tl.program_id(1) + 0 * lane
    elif LAYOUT == 1:
        channel = tl.program_id(1) * BLOCK_COL + lane
    else:
        channel = lane % m
    least_kappa = tl.min(tl.load(table + channel, mask=channel < m, other=400.0), 0)
    if ROBUST:
        low = tl.min(tl.load(table + 10 * m + channel, mask=channel < m, other=1.0), 0)
        high = tl.max(tl.load(table + 10 * m + channel, mask=channel < m, other=0.0), 0)
        # most batches are before or after the annealing, where a single loss is used
        if high <= 0.0:
            sum_network, sum_energy, sum_kappa, sum_d, sum_weight = walk_by_kappa(
                least_kappa, x, t, w, upstream, values, slopes, table, outer, inner, so, sc, sk, wo, wc, wk, uo, uc, uk,
                programs, elements, factor, CHANNELS, BLOCK_ROW, BLOCK_COL, LAYOUT, HAS_WEIGHT, each, False, True,
                LEARN_KAPPA, LEARN_D, NORMALIZE, WRITE_VALUES, WRITE_SLOPES, SUMS, WIDE,
            )  # fmt: skip
        elif low >= 1.0:
            sum_network, sum_energy, sum_kappa, sum_d, sum_weight = walk_by_kappa(
                least_kappa, x, t, w, upstream, values, slopes, table, outer, inner, so, sc, sk, wo, wc, wk, uo, uc, uk,
                programs, elements, factor, CHANNELS, BLOCK_ROW, BLOCK_COL, LAYOUT, HAS_WEIGHT, each, True, False,
                LEARN_KAPPA, LEARN_D, NORMALIZE, WRITE_VALUES, WRITE_SLOPES, SUMS, WIDE,
            )  # fmt: skip
        else:
            sum_network, sum_energy, sum_kappa, sum_d, sum_weight = walk_by_kappa(
                least_kappa, x, t, w, upstream, values, slopes, table, outer, inner, so, sc, sk, wo, wc, wk, uo, uc, uk,
                programs, elements, factor, CHANNELS, BLOCK_ROW, BLOCK_COL, LAYOUT, HAS_WEIGHT, each, True, True,
                LEARN_KAPPA, LEARN_D, NORMALIZE, WRITE_VALUES, WRITE_SLOPES, SUMS, WIDE,
            )  # fmt: skip
    else:
        sum_network, sum_energy, sum_kappa, sum_d, sum_weight = walk_by_kappa(
            least_kappa, x, t, w, upstream, values, slopes, table, outer, inner, so, sc, sk, wo, wc, wk, uo, uc, uk,
            programs, elements, factor, CHANNELS, BLOCK_ROW, BLOCK_COL, LAYOUT, HAS_WEIGHT, each, False, False,
            LEARN_KAPPA, LEARN_D, NORMALIZE, WRITE_VALUES, WRITE_SLOPES, SUMS, WIDE,
        )  # fmt: skip
    if SUMS:
        total_energy, total_network = tl.sum(sum_energy, 0), tl.sum(sum_network, 0)
        total_kappa, total_d, total_given = tl.sum(sum_kappa, 0), tl.sum(sum_d, 0), tl.sum(sum_weight, 0)
        if LAYOUT == 0:  # the single channel of this program, in the first lane
            total_energy = tl.where(lane == 0, tl.sum(total_energy, 0), 0.0)
            total_network = tl.where(lane == 0, tl.sum(total_network, 0), 0.0)
            total_kappa = tl.where(lane == 0, tl.sum(total_kappa, 0), 0.0)
            total_d = tl.where(lane == 0, tl.sum(total_d, 0), 0.0)
            total_given = tl.where(lane == 0, tl.sum(total_given, 0), 0.0)
            channel_out, known_out = tl.program_id(1) + 0 * lane, lane == 0
        elif LAYOUT == 1:
            channel_out = tl.program_id(1) * BLOCK_COL + lane
            known_out = channel_out < m
        else:
            channel_out = tl.arange(0, CHANNELS)
            known_out = channel_out >= 0
            total_energy = tl.sum(tl.reshape(total_energy, (BLOCK_COL // CHANNELS, CHANNELS)), 0)
            total_network = tl.sum(tl.reshape(total_network, (BLOCK_COL // CHANNELS, CHANNELS)), 0)
            total_kappa = tl.sum(tl.reshape(total_kappa, (BLOCK_COL // CHANNELS, CHANNELS)), 0)
            total_d = tl.sum(tl.reshape(total_d, (BLOCK_COL // CHANNELS, CHANNELS)), 0)
            total_given = tl.sum(tl.reshape(total_given, (BLOCK_COL // CHANNELS, CHANNELS)), 0)
        if FINISH:
            each_weight = tl.full((), 1.0, like) * elements / CHANNELS
            if UPSTREAM == 2:
                each_weight = total_given
            elif HAS_WEIGHT:
                each_weight = tl.load(weights + channel_out, mask=known_out, other=0.0).to(like)
            part_of_value = finish(
                total_network, total_energy, total_kappa, total_d, each_weight, table, channel_out, known_out, m,
                divisor, LEARN_KAPPA, LEARN_D, NORMALIZE, by_kappa, by_d,
            )  # fmt: skip
            tl.store(value, tl.sum(tl.where(known_out, part_of_value, 0.0), 0))
        else:
            at = partial + tl.program_id(0) * m + channel_out
            step = programs * m
            tl.store(at, total_energy, mask=known_out)
            if ROBUST:
                tl.store(at + step, total_network, mask=known_out)
            if LEARN_KAPPA:
                tl.store(at + 2 * step, total_kappa, mask=known_out)
            if LEARN_D:
                tl.store(at + 3 * step, total_d, mask=known_out)
            if UPSTREAM == 2:
                tl.store(at + 4 * step, total_given, mask=known_out)


@triton.jit
def finish_kernel(
    partial, table, weights, total_weight, value, by_kappa, by_d, m, programs, each_weight, count,
    BLOCK_ROW: tl.constexpr, BLOCK_COL: tl.constexpr, HAS_WEIGHT: tl.constexpr, MEAN: tl.constexpr,
    ROBUST: tl.constexpr, LEARN_KAPPA: tl.constexpr, LEARN_D: tl.constexpr, NORMALIZE: tl.constexpr,
    GIVEN: tl.constexpr, WIDE: tl.constexpr,
):  # fmt: skip
    """Add up the sums of all programs in a fixed order and finish; ``value`` gets a summand per program."""
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
    """Multiply stored gradients by the upstream gradient, in place; nothing is read if that is 1."""
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
