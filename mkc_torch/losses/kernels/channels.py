"""Running state and numbers of each channel: one program per channel."""

from __future__ import annotations

import triton
import triton.language as tl

from mkc_torch.losses.kernels.formulas import initial, log_partition

TABLE = (
    "kappa",
    "d",
    "kappa_by_raw",
    "d_by_raw",
    "log_normalizer",
    "log_normalizer_by_kappa",
    "log_normalizer_by_d",
    "annealed_kappa",
    "annealed_d",
    "scale",
    "share",
    "bound",
    "floor",
    "log_bandwidth",
)
"""Rows of the table (14, m) for a pass over a batch: the fields of ChannelTable, then the rest of ChannelState."""


@triton.jit
def quantile(size, weight, LEVEL: tl.constexpr, WIDE: tl.constexpr):
    """Weighted quantile at LEVEL of non-negative sizes, by bisection on the bits of the number."""
    wanted = LEVEL * tl.sum(weight, 0)
    if WIDE:
        bits = size.to(tl.int64, bitcast=True)
        low = tl.sum(tl.zeros_like(bits), 0)
        high = low + 0x7FF0000000000000
        for _ in range(63):
            middle = low + (high - low) // 2
            reached = tl.sum(tl.where(bits <= middle, weight, 0.0), 0) >= wanted
            high = tl.where(reached, middle, high)
            low = tl.where(reached, low, middle + 1)
        found = high.to(tl.float64, bitcast=True)
    else:
        bits = size.to(tl.int32, bitcast=True)
        low = tl.sum(tl.zeros_like(bits), 0)
        high = low + 0x7F800000
        for _ in range(31):
            middle = low + (high - low) // 2
            reached = tl.sum(tl.where(bits <= middle, weight, 0.0), 0) >= wanted
            high = tl.where(reached, middle, high)
            low = tl.where(reached, low, middle + 1)
        found = high.to(tl.float32, bitcast=True)
    return found


@triton.jit
def load_rows(x, t, w, row, mask, channel, inner, so, sc, sk, wo, wc, wk, HAS_WEIGHT: tl.constexpr, like):
    """Residuals, predictions and weights of rows of a batch; 0 where masked or not finite."""
    outer, k = row // inner, row % inner
    place = outer * so + channel * sc + k * sk
    prediction = tl.load(x + place, mask=mask, other=0.0).to(like)
    residual = prediction - tl.load(t + place, mask=mask, other=0.0).to(like)
    counts = mask & (residual - residual == 0.0)
    weight = tl.where(counts, 1.0, 0.0).to(like)
    if HAS_WEIGHT:
        given = tl.load(w + outer * wo + channel * wc + k * wk, mask=mask, other=0).to(like)
        weight = tl.where(counts, given, 0.0)
        counts = counts & (given > 0)
    return tl.where(counts, residual, 0.0), tl.where(counts, prediction, 0.0), weight


@triton.jit
def risk_of(influence, slope, share, step_of_initial, standardised, size):
    """Estimated risk of a loss: variance plus the square of the shrinkage beyond chance."""
    slope = tl.maximum(tl.sum(slope * share, 0), 1e-3)
    mean = tl.sum(influence * share, 0)
    variance = tl.sum(influence * influence * share, 0) / (slope * slope)
    step = (influence - mean) * standardised / slope - step_of_initial
    shrinkage = tl.sum(step * share, 0)
    off = step - shrinkage
    spread = tl.sum(off * off * share, 0)
    gain = tl.maximum(shrinkage, 0.0)
    return variance + tl.maximum(size * gain * gain - 9.0 * spread, 0.0)


@triton.jit
def channel_kernel(
    x, t, w,
    recent, position, batches, log_scale, half_range,
    steps, log_bandwidth, share,
    kappa_given, d_given, bound_given, floor_given,
    table, rule, widths,
    rows, m, inner, so, sc, sk, wo, wc, wk,
    range_rows, warmup, anneal_step,
    LENGTH: tl.constexpr, LENGTH_PAD: tl.constexpr, RANGE_BLOCK: tl.constexpr,
    SCALE: tl.constexpr, PEEK: tl.constexpr, SCHEDULE: tl.constexpr, MAKE_TABLE: tl.constexpr, HAS_WEIGHT: tl.constexpr,
    HAS_SCALE: tl.constexpr, ROBUST: tl.constexpr, FOLLOWS: tl.constexpr,
    LEARN_KAPPA: tl.constexpr, LEARN_D: tl.constexpr, OWN_BOUND: tl.constexpr, OWN_FLOOR: tl.constexpr,
    NORMALIZE: tl.constexpr, WIDTHS: tl.constexpr, WIDTHS_PAD: tl.constexpr, NODES: tl.constexpr, WIDE: tl.constexpr,
):  # fmt: skip
    """Update the running scale (SCALE) and the schedule (SCHEDULE) by a batch, and fill the table (MAKE_TABLE).

    With PEEK the scale is not stored: channels without a batch so far take it from this batch, for the table alone.
    """
    channel = tl.program_id(0)
    like = tl.float64 if WIDE else tl.float32
    slot = tl.arange(0, LENGTH_PAD)
    inside = slot < LENGTH
    at = channel * LENGTH + slot
    if SCALE or PEEK:
        count = tl.minimum(rows, LENGTH)
        start = tl.load(position + channel)
        if PEEK:
            start = start * 0
        age = (slot - start + LENGTH) % LENGTH
        new = inside & (age < count)
        row = (age.to(tl.int64) * rows) // count
        residual, prediction, weight = load_rows(
            x, t, w, row, new, channel, inner, so, sc, sk, wo, wc, wk, HAS_WEIGHT, like
        )
        given = tl.sum(weight, 0)
        if SCALE:
            plane = m * LENGTH
            residual = tl.where(new, residual, tl.load(recent + at, mask=inside, other=0.0).to(like))
            prediction = tl.where(new, prediction, tl.load(recent + plane + at, mask=inside, other=0.0).to(like))
            weight = tl.where(new, weight, tl.load(recent + 2 * plane + at, mask=inside, other=0.0).to(like))
            tl.store(recent + at, residual, mask=new)
            tl.store(recent + plane + at, prediction, mask=new)
            tl.store(recent + 2 * plane + at, weight, mask=new)
            tl.store(position + channel, (start + count) % LENGTH)
        low, high = tl.full((RANGE_BLOCK,), float("inf"), like), tl.full((RANGE_BLOCK,), float("-inf"), like)
        for first in range(0, range_rows, RANGE_BLOCK):
            index = first + tl.arange(0, RANGE_BLOCK)
            mask = index < range_rows
            value, _, counted = load_rows(
                x,
                t,
                w,
                (index.to(tl.int64) * rows) // range_rows,
                mask,
                channel,
                inner,
                so,
                sc,
                sk,
                wo,
                wc,
                wk,
                HAS_WEIGHT,
                like,
            )
            low = tl.where(counted > 0, tl.minimum(low, value), low)
            high = tl.where(counted > 0, tl.maximum(high, value), high)
        span = tl.maximum(0.5 * tl.max(high, 0) - 0.5 * tl.min(low, 0), 0.0)
        size = tl.abs(residual)
        part = weight / tl.maximum(tl.sum(weight, 0), 1e-30)
        candidate = quantile(size, weight, 0.4, WIDE) / 0.5244005
        candidate = tl.where(candidate > 0, candidate, tl.sum(size * part, 0))
        known = (candidate > 0) & (candidate < float("inf")) & (given > 0)
        seen, old = tl.load(batches + channel), tl.load(log_scale + channel).to(like)
        begins = known & (seen == 0)
        found = tl.where(known, tl.log(tl.maximum(candidate, 1e-30)), old)
        rate = tl.maximum(1.0 / (seen.to(like) + 1.0), 0.1)
        own = tl.where(begins, found, old + rate * (found - old))
        old_range = tl.load(half_range + channel).to(like)
        wider = tl.maximum(span, 0.999 * old_range)
        wider = tl.where(begins, span, tl.where(known, wider, old_range))
        if SCALE:
            tl.store(batches + channel, seen + known.to(tl.int64))
            tl.store(log_scale + channel, own)
            tl.store(half_range + channel, wider)
        else:
            own, wider = tl.where(seen == 0, own, old), tl.where(seen == 0, wider, old_range)
    if SCHEDULE:
        step_count = tl.load(steps + channel)
        if not SCALE:
            residual = tl.load(recent + at, mask=inside, other=0.0).to(like)
            prediction = tl.load(recent + m * LENGTH + at, mask=inside, other=0.0).to(like)
            weight = tl.load(recent + 2 * m * LENGTH + at, mask=inside, other=0.0).to(like)
            own = tl.load(log_scale + channel).to(like)
        if step_count % 4 == 0:
            share_of = weight / tl.maximum(tl.sum(weight, 0), 1e-30)
            z = residual / tl.exp(own)
            centred = tl.where(share_of > 0, prediction - tl.sum(prediction * share_of, 0), 0.0)
            centred = centred / tl.maximum(tl.max(tl.abs(centred), 0), 1e-30)
            centred = centred / tl.maximum(tl.sqrt(tl.sum(centred * centred * share_of, 0)), 1e-30)
            effective = 1.0 / tl.maximum(tl.sum(share_of * share_of, 0), 1e-30)
            ratio = z * 5.0
            bend = 1.0 + ratio * ratio
            _, influence = initial(z, WIDE)
            bend_slope = (1.0 - 1.5 * (bend - 1.0) / bend) / (tl.sqrt(bend) * tl.sqrt(tl.sqrt(bend)))
            initial_slope = tl.maximum(tl.sum(bend_slope * share_of, 0), 1e-3)
            initial_step = (influence - tl.sum(influence * share_of, 0)) * centred / initial_slope
            initial_risk = risk_of(influence, bend_slope, share_of, initial_step, centred, effective)
            lane = tl.arange(0, WIDTHS_PAD)
            width = tl.load(widths + lane, mask=lane < WIDTHS, other=0.0).to(like)
            risks = tl.full((WIDTHS_PAD,), float("inf"), like)
            for k in range(WIDTHS):
                square = z / tl.load(widths + k).to(like)
                square = tl.minimum(square * square, 1e4)
                inlier = tl.exp(-0.5 * square)
                risk = risk_of(z * inlier, (1.0 - square) * inlier, share_of, initial_step, centred, effective)
                risks = tl.where(lane == k, risk, risks)
            least_risk = 1.1 * tl.min(risks, 0)
            chosen = tl.max(tl.where(risks <= least_risk, width, 0.0), 0)
            counted = step_count.to(like)
            pace = tl.minimum(tl.maximum(4.0 / (counted + 1.0), 0.3439), 1.0)
            old_width = tl.load(log_bandwidth + channel).to(like)
            new_width = old_width + pace * (tl.log(tl.where(chosen > 0, chosen, 1.0)) - old_width)
            tl.store(log_bandwidth + channel, tl.where(chosen > 0, new_width, old_width).to(like))
            annealing = (step_count >= warmup) & (tl.sum(weight * tl.abs(residual), 0) > 0)
            change = 4.0 * anneal_step * tl.where(least_risk < initial_risk, 1.0, -1.0)
            before = tl.load(share + channel).to(like)
            after = tl.minimum(tl.maximum(before + change, 0.0), 1.0)
            tl.store(share + channel, tl.where(annealing, after, before).to(like))
        tl.store(steps + channel, step_count + 1)
    if MAKE_TABLE:
        row = tl.arange(0, 16)
        tl.store(table + row * m + channel, tl.zeros((16,), like), mask=row < 14)
        tl.debug_barrier()  # the rows stored above are loaded or stored again below
        if HAS_SCALE:
            if not (SCALE or PEEK):
                own, wider = tl.load(log_scale + channel), tl.load(half_range + channel)
            scale = tl.exp(own.to(tl.float64))
            bound = tl.maximum(wider.to(tl.float64), 10.0 * scale)
            least = 1e-3 * scale
        else:
            scale, bound, least = 1.0, 1.0, 0.0
        if OWN_BOUND:
            bound = tl.load(bound_given + channel).to(tl.float64)
        if OWN_FLOOR:
            least = tl.load(floor_given + channel).to(tl.float64)
        kappa, kappa_by_raw = tl.load(kappa_given + channel).to(tl.float64), 0.0
        if LEARN_KAPPA:
            part = 1.0 / (1.0 + tl.exp(-tl.maximum(kappa, -700.0)))
            kappa, kappa_by_raw = 400.0 * part, 400.0 * part * (1.0 - part)
        d_by_raw = 0.0
        if FOLLOWS:
            free = scale
            if LEARN_D:
                raw = tl.load(d_given + channel).to(tl.float64)
                slope = 2.0 / (1.0 + tl.exp(-raw)) - 1.0  # the hyperbolic tangent of raw / 2
                free = scale * tl.exp(2.0 * slope)
                d_by_raw = free * (1.0 - slope * slope)
            d = tl.minimum(tl.maximum(free, least), 0.5 * bound)
            d_by_raw = tl.where(d == free, d_by_raw, 0.0)
        else:
            d = tl.load(d_given + channel).to(tl.float64)
            if LEARN_D:
                part = 1.0 / (1.0 + tl.exp(-tl.maximum(d, -700.0)))
                d, d_by_raw = least + (bound - least) * part, (bound - least) * part * (1.0 - part)
        tl.store(table + channel, kappa.to(like))
        tl.store(table + m + channel, d.to(like))
        if LEARN_KAPPA:
            tl.store(table + 2 * m + channel, kappa_by_raw.to(like))
        if LEARN_D:
            tl.store(table + 3 * m + channel, d_by_raw.to(like))
        if NORMALIZE:
            length = bound / d
            log_z, by_kappa, by_length = log_partition(kappa, length, rule, NODES)
            tl.store(table + 4 * m + channel, (tl.log(d) + log_z).to(like))
            tl.store(table + 5 * m + channel, by_kappa.to(like))
            tl.store(table + 6 * m + channel, ((1.0 - by_length * length) / d).to(like))
        if ROBUST:
            log_width = tl.load(log_bandwidth + channel).to(tl.float64)
            if FOLLOWS:
                annealed = tl.exp(-2.0 * log_width)
                annealed_d = scale
            else:
                ratio = d / (tl.exp(log_width) * scale)
                annealed = tl.maximum(kappa, tl.where(log_width < 3.4657359027997265, ratio * ratio, 0.0))
                annealed_d = d
            tl.store(table + 7 * m + channel, annealed.to(like))
            tl.store(table + 8 * m + channel, annealed_d.to(like))
            tl.store(table + 9 * m + channel, scale.to(like))
            tl.store(table + 10 * m + channel, tl.load(share + channel).to(like))
            tl.store(table + 13 * m + channel, log_width.to(like))
        elif HAS_SCALE:
            tl.store(table + 9 * m + channel, scale.to(like))
        if HAS_SCALE or OWN_BOUND:
            tl.store(table + 11 * m + channel, bound.to(like))
        if HAS_SCALE or OWN_FLOOR:
            tl.store(table + 12 * m + channel, least.to(like))
