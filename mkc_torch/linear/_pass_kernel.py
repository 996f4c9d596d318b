"""Triton kernel of a pass over the rows of one channel; ``_fused_pass`` launches it."""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def pass_kernel(
    x, y, w, point, partial, weights,
    rows, x_row, x_column, y_row, w_row, length,
    N: tl.constexpr, COLUMNS: tl.constexpr, BLOCK: tl.constexpr, HAS_WEIGHT: tl.constexpr, CURVATURE: tl.constexpr,
    WRITE: tl.constexpr, LEAST: tl.constexpr,
):  # fmt: skip
    """Sums of one program; ``point`` holds κ, 1 / (2 d²) and the coefficients."""
    column = tl.arange(0, COLUMNS)
    inside = column < N
    lane = tl.arange(0, BLOCK).to(tl.int64)
    kappa, half = tl.load(point), tl.load(point + 1)
    divisor = tl.where(kappa > 0, kappa, 1.0)
    coef = tl.load(point + 2 + column, mask=inside, other=0.0)
    zero = tl.zeros((BLOCK,), tl.float64)
    total, residual, energy, first, second, qw_sum, q2w_sum = zero, zero, zero, zero, zero, zero, zero
    square, light = zero, zero
    low, high = zero + float("inf"), zero - float("inf")
    score = tl.zeros((BLOCK, COLUMNS), tl.float64)
    if CURVATURE:
        tilt, moment = tl.zeros((BLOCK, COLUMNS), tl.float64), tl.zeros((BLOCK, COLUMNS), tl.float64)
        curvature = tl.zeros((BLOCK, COLUMNS, COLUMNS), tl.float64)
        spread = tl.zeros((BLOCK, COLUMNS, COLUMNS), tl.float64)
    blocks = (rows + BLOCK - 1) // BLOCK
    for number in range(tl.program_id(0), blocks, tl.num_programs(0)):
        row = (number + 0 * lane) * BLOCK + lane
        mask = row < rows
        place = x + row[:, None] * x_row + column[None, :] * x_column
        values = tl.load(place, mask=mask[:, None] & inside[None, :], other=0.0).to(tl.float64)
        target = tl.load(y + row * y_row, mask=mask, other=0.0).to(tl.float64)
        e = target - tl.sum(values * coef[None, :], 1)
        if HAS_WEIGHT:
            own = tl.load(w + row * w_row, mask=mask, other=0.0).to(tl.float64)
        else:
            own = tl.where(mask, 1.0, 0.0).to(tl.float64)
        q = tl.minimum(e * e * half, 1e100)
        exponent = kappa * q
        inlier = tl.exp(-exponent)
        qw, weighted = q * inlier, own * inlier
        # below this exponent the differences lose more digits than a series of two terms
        near = exponent < 1e-5
        value = tl.where(near, q - 0.5 * q * exponent, (1.0 - inlier) / divisor)
        slope = tl.where(near, q * q * (0.5 - exponent / 3.0), (value - qw) / divisor)
        bend = tl.where(near, q * q * q * (1.0 / 3.0 - 0.25 * exponent), (2.0 * slope - q * qw) / divisor)
        total += own
        residual += own * e
        energy += own * value
        first += own * slope
        second += own * bend
        qw_sum += own * qw
        q2w_sum += own * q * qw
        used = mask & (own > 0)
        low = tl.where(used, tl.minimum(low, e), low)
        high = tl.where(used, tl.maximum(high, e), high)
        score += (weighted * e)[:, None] * values
        if CURVATURE:
            square += own * e * e
            light += tl.where(mask & (inlier < LEAST), 1.0, 0.0)
            tilt += (q * weighted * e)[:, None] * values
            moment += (own * e)[:, None] * values
            by_curvature = weighted * (1.0 - 2.0 * exponent) * (2.0 * half)
            by_score = weighted * e * (2.0 * half)
            curvature += (by_curvature[:, None] * values)[:, :, None] * values[:, None, :]
            spread += ((by_score * by_score)[:, None] * values)[:, :, None] * values[:, None, :]
        if WRITE:
            tl.store(weights + row, inlier, mask=mask)
    out = partial + tl.program_id(0) * length
    tl.store(out, tl.min(low, 0))
    tl.store(out + 1, tl.max(high, 0))
    tl.store(out + 2, tl.sum(total, 0))
    tl.store(out + 3, tl.sum(residual, 0))
    tl.store(out + 4, tl.sum(energy, 0))
    tl.store(out + 5, tl.sum(first, 0))
    tl.store(out + 6, tl.sum(second, 0))
    tl.store(out + 7, tl.sum(qw_sum, 0))
    tl.store(out + 8, tl.sum(q2w_sum, 0))
    out += 9
    tl.store(out + column, tl.sum(score, 0), mask=inside)
    if CURVATURE:
        product = column[:, None] * N + column[None, :]
        both = inside[:, None] & inside[None, :]
        out += N
        tl.store(out + product, tl.sum(curvature, 0), mask=both)
        tl.store(out + N * N + product, tl.sum(spread, 0), mask=both)
        out += 2 * N * N
        tl.store(out + column, tl.sum(tilt, 0), mask=inside)
        tl.store(out + N + column, tl.sum(moment, 0), mask=inside)
        tl.store(out + 2 * N, tl.sum(square, 0))
        tl.store(out + 2 * N + 1, tl.sum(light, 0))
