"""Triton kernels of weighted fits and concentration steps on many small problems; ``_concentration`` launches them."""

from __future__ import annotations

import triton
import triton.language as tl

_NUMBERS = (
    "starts", "sets", "samples", "x_batch", "w_batch", "max_iter", "has_near", "keeps", "newton_steps", "is_exact",
)  # fmt: skip
"""Numbers of which the compiled form does not depend: with many columns it takes seconds to compile."""


@triton.jit
def _weight_of(among, weight, HAS_WEIGHT: tl.constexpr):
    """The total weight of some samples; without weights their number, which is summed in integers."""
    return tl.sum(tl.where(among, weight, 0.0), 0) if HAS_WEIGHT else tl.sum(among.to(tl.int32), 0).to(tl.float64)


@triton.jit
def _least_reaching(keys, weight, among, target, HAS_WEIGHT: tl.constexpr):
    """The least of the keys, 32-bit integers, whose cumulated weight reaches ``target``, by bisection."""
    low = tl.min(tl.where(among, keys, 0x7FFFFFFF), 0).to(tl.int64) - 1
    high = tl.max(tl.where(among, keys, -0x80000000), 0).to(tl.int64)
    while high - low > 1:
        middle = low + ((high - low) >> 1)
        below = among & (keys <= middle.to(tl.int32))
        reached = _weight_of(below, weight, HAS_WEIGHT)
        if reached >= target:
            # no key lies between the largest of these and the middle
            high = tl.max(tl.where(below, keys, -0x80000000), 0).to(tl.int64)
            if not HAS_WEIGHT:
                low = tl.where(reached == target, high - 1, low)
        else:
            low = middle
    return high.to(tl.int32)


@triton.jit
def _order_statistic(sizes, weight, valid, target, HAS_WEIGHT: tl.constexpr):
    """The least of the sizes >= 0 whose cumulated weight reaches ``target``.

    The upper and the lower halves of the bits are searched one after the other: few sizes have the same upper half.
    """
    bits = sizes.to(tl.int64, bitcast=True)
    upper = (bits >> 32).to(tl.int32)
    found = _least_reaching(upper, weight, valid, target, HAS_WEIGHT)
    # signed integers in the order of the unsigned halves
    lower = (bits ^ 0x80000000).to(tl.int32)
    left = target - _weight_of(valid & (upper < found), weight, HAS_WEIGHT)
    rest = _least_reaching(lower, weight, valid & (upper == found), left, HAS_WEIGHT)
    joined = (found.to(tl.int64) << 32) | ((rest.to(tl.int64) & 0xFFFFFFFF) ^ 0x80000000)
    return joined.to(tl.float64, bitcast=True)


@triton.jit
def weighted_fit(x, target_y, weight, valid, samples, N: tl.constexpr, COLUMNS: tl.constexpr):
    """Weighted least-squares coefficients; ``x`` points to the samples of the first column."""
    column = tl.arange(0, COLUMNS)
    gram = tl.zeros((COLUMNS, COLUMNS), tl.float64)
    moment = tl.zeros((COLUMNS,), tl.float64)
    for j in tl.static_range(N):
        weighted = weight * tl.load(x + j * samples, mask=valid, other=0.0).to(tl.float64)
        moment = tl.where(column == j, tl.sum(weighted * target_y, 0), moment)
        for k in tl.static_range(j + 1):
            other = tl.load(x + k * samples, mask=valid, other=0.0).to(tl.float64)
            place = (column[:, None] == j) & (column[None, :] == k)
            place = place | ((column[:, None] == k) & (column[None, :] == j))
            gram = tl.where(place, tl.sum(weighted * other, 0), gram)
    diagonal = tl.where(column[:, None] == column[None, :], gram, 0.0)
    least = N * 2.3e-16 * tl.max(tl.max(diagonal, 1), 0)
    for j in tl.static_range(N):
        by_column = tl.sum(tl.where(column[None, :] == j, gram, 0.0), 1)
        by_row = tl.sum(tl.where(column[:, None] == j, gram, 0.0), 0)
        pivot = tl.sum(tl.where(column == j, by_row, 0.0), 0)
        value = tl.sum(tl.where(column == j, moment, 0.0), 0)
        # the coefficient of a direction without weight is 0
        inverse = tl.where(pivot > least, 1.0 / tl.where(pivot > least, pivot, 1.0), 0.0)
        here = column == j
        moment = tl.where(here, value * inverse, moment - by_column * (value * inverse))
        others = gram - by_column[:, None] * (by_row * inverse)[None, :]
        gram = tl.where(here[:, None], (by_row * inverse)[None, :], others)
    return moment


@triton.jit(do_not_specialize=_NUMBERS)
def concentration_kernel(
    x, y, w, start, near, settings, beta_out, scale_out, steps_out,
    starts, samples, x_batch, w_batch, max_iter, has_near, keeps, newton_steps, is_exact,
    N: tl.constexpr, COLUMNS: tl.constexpr, BLOCK: tl.constexpr, RULE: tl.constexpr, HAS_WEIGHT: tl.constexpr,
):  # fmt: skip
    """One start of one problem: steps until the log scale falls by no more than the tolerance, at most ``max_iter``.

    ``x`` holds the columns (B, N, samples). ``settings`` holds the rank of the order statistic, c, the share of the
    total weight that the sum of ρ is, the coefficients that it loses, the tolerance and the smallest scale. ``keeps``:
    the scale before a step is the first guess of the next. ``is_exact``: Newton steps solve for an M-scale to rounding.
    """
    program = tl.program_id(0).to(tl.int64)
    problem = program // starts
    lane = tl.arange(0, BLOCK)
    valid = lane < samples
    column = tl.arange(0, COLUMNS)
    target_y = tl.load(y + problem * samples + lane, mask=valid, other=0.0).to(tl.float64)
    if HAS_WEIGHT:
        own = tl.load(w + problem * w_batch + lane, mask=valid, other=0.0).to(tl.float64)
        total = tl.sum(own, 0)
        rank = tl.load(settings) * total / samples * (1.0 - 1e-12)
    else:
        own = tl.where(valid, 1.0, 0.0).to(tl.float64)
        total = samples.to(tl.float64)
        rank = tl.load(settings)
    c, breakdown, lost = tl.load(settings + 1), tl.load(settings + 2), tl.load(settings + 3)
    tolerance, tiny = tl.load(settings + 4), tl.load(settings + 5)
    x += problem * x_batch + lane
    beta = tl.load(start + program * N + column, mask=column < N, other=0.0).to(tl.float64)
    known = has_near > 0
    scale = tl.load(near + program, mask=known, other=0.0).to(tl.float64)
    objective = tl.zeros((), tl.float64) + float("inf")
    step, going, falling = 0, True, True
    while going:
        residual = target_y
        for j in tl.static_range(N):
            coef = tl.sum(tl.where(column == j, beta, 0.0), 0)
            residual -= tl.load(x + j * samples, mask=valid, other=0.0).to(tl.float64) * coef
        square = residual * residual
        weight = own
        if RULE == 0:
            scale = _order_statistic(tl.abs(residual), own, valid, rank, HAS_WEIGHT)
        elif RULE == 1:
            threshold = _order_statistic(square, own, valid, rank, HAS_WEIGHT)
            kept = tl.load(settings) * total / samples if HAS_WEIGHT else rank
            weight = tl.where(square <= threshold, own, 0.0)
            # of tied values only as many as needed enter
            trimmed = tl.sum(weight * square, 0) - (tl.sum(weight, 0) - kept) * threshold
            scale = tl.sqrt(tl.maximum(trimmed, 0.0) / kept)
        else:
            wanted = breakdown * tl.maximum(total - lost, 1.0)
            solving = True
            while solving:
                if not known:
                    scale = 1.4826 * _order_statistic(tl.abs(residual), own, valid, rank, HAS_WEIGHT)
                newton, exact = 0, False
                while (newton < newton_steps) & (not exact):
                    size = c * tl.maximum(scale, tiny)
                    inner = tl.maximum(1.0 - square / (size * size), 0.0)
                    second = own * inner * inner
                    outside = tl.sum(second * inner, 0)
                    slope = 6.0 * (tl.sum(second, 0) - outside)
                    gap = total - outside - wanted
                    # a flat sum cannot overflow, since steps are limited to a factor of two
                    move = gap / tl.maximum(tl.maximum(slope, tl.abs(gap)), tiny)
                    move = tl.minimum(tl.maximum(move, -0.7), 0.7)
                    # the next error is about the square of this step
                    exact = (is_exact > 0) & (tl.abs(move) < 0.7e-8)
                    scale = scale * tl.exp(tl.where(scale > 0.0, move, 0.0))
                    newton += 1
                # a scale that collapsed is solved again without the first guess
                solving = (is_exact > 0) & known & (not exact)
                known = False
            size = c * tl.maximum(scale, tiny)
            inner = tl.maximum(1.0 - square / (size * size), 0.0)
            weight = own * inner * inner
        known = keeps > 0
        before = tl.log(tl.maximum(scale, tiny))
        falling = objective - before > tolerance
        objective = tl.minimum(objective, before)
        going = falling & (step < max_iter) & (RULE > 0)
        if going:
            beta = weighted_fit(x, target_y, weight, valid, samples, N, COLUMNS)
            step += 1
    tl.store(beta_out + program * N + column, beta, mask=column < N)
    tl.store(scale_out + program, scale)
    # negative where the last step lowered the scale
    tl.store(steps_out + program, tl.where(falling, -step - 1, step))


@triton.jit
def weighted_fit_kernel(
    x, y, w, weights, beta_out,
    sets, samples, x_batch, w_batch,
    N: tl.constexpr, COLUMNS: tl.constexpr, BLOCK: tl.constexpr, HAS_WEIGHT: tl.constexpr,
):  # fmt: skip
    """Weighted least squares of one problem with one of its sets of weights (B, sets, samples)."""
    program = tl.program_id(0).to(tl.int64)
    problem = program // sets
    lane = tl.arange(0, BLOCK)
    valid = lane < samples
    column = tl.arange(0, COLUMNS)
    target_y = tl.load(y + problem * samples + lane, mask=valid, other=0.0).to(tl.float64)
    weight = tl.load(weights + program * samples + lane, mask=valid, other=0.0).to(tl.float64)
    if HAS_WEIGHT:
        weight *= tl.load(w + problem * w_batch + lane, mask=valid, other=0.0).to(tl.float64)
    beta = weighted_fit(x + problem * x_batch + lane, target_y, weight, valid, samples, N, COLUMNS)
    tl.store(beta_out + program * N + column, beta, mask=column < N)
