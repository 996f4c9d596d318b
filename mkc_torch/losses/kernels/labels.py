"""Generalized cross-entropy of integer labels: several rows of logits per tile, or a row in several blocks."""

from __future__ import annotations

import triton
import triton.language as tl

from mkc_torch.losses.kernels.formulas import series


@triton.jit
def weight_of(target, class_weight, row, mask, ignored, like, CLASSES: tl.constexpr, HAS_WEIGHT: tl.constexpr):
    """Labels and their weights: 0 where ignored, NaN for a label out of range."""
    label = tl.load(target + row, mask=mask, other=0).to(tl.int64)
    counts = mask & (label != ignored)
    known = counts & (label >= 0) & (label < CLASSES)
    if HAS_WEIGHT:
        weight = tl.load(class_weight + label, mask=known, other=0.0).to(like)
    else:
        weight = tl.where(known, 1.0, 0.0).to(like)
    return label, tl.where(counts & (known == 0), float("nan"), weight)


@triton.jit
def count_kernel(
    target, class_weight, counted, rows, ignored, programs,
    CLASSES: tl.constexpr, BLOCK: tl.constexpr, HAS_WEIGHT: tl.constexpr, WIDE: tl.constexpr,
):  # fmt: skip
    """Sums of the weights of labels, one per program."""
    like = tl.float64 if WIDE else tl.float32
    sums = tl.zeros((BLOCK,), like)
    for block in range(tl.program_id(0), tl.cdiv(rows, BLOCK), programs):
        row = tl.full((), BLOCK, tl.int64) * block + tl.arange(0, BLOCK)
        _, weight = weight_of(target, class_weight, row, row < rows, ignored, like, CLASSES, HAS_WEIGHT)
        sums += weight
    tl.store(counted + tl.program_id(0), tl.sum(sums, 0))


@triton.jit
def labels_kernel(
    x, target, class_weight, upstream, kappa, counted,
    values, slopes, partial,
    rows, ignored, parts, programs,
    CLASSES: tl.constexpr, BLOCK_ROW: tl.constexpr, BLOCK_CLASS: tl.constexpr, PARTS: tl.constexpr,
    HAS_WEIGHT: tl.constexpr, MEAN: tl.constexpr, UPSTREAM: tl.constexpr,
    WRITE_VALUES: tl.constexpr, WRITE_SLOPES: tl.constexpr, SUMS: tl.constexpr, WIDE: tl.constexpr,
):  # fmt: skip
    """Values of rows (WRITE_VALUES), gradients of the logits (WRITE_SLOPES), a summand of the value per program (SUMS).

    The logits are (rows, CLASSES), contiguous. A tile holds BLOCK_ROW whole rows, or BLOCK_ROW is 1 and a row has
    several tiles. The weight of a mean is the sum of ``parts`` numbers of ``counted``, at most PARTS; with PARTS = 0
    each program adds it up. UPSTREAM: 0 if the upstream gradient is 1, 1 if it is a number, 2 if each row has its own.
    """
    like = tl.float64 if WIDE else tl.float32
    lane = tl.arange(0, BLOCK_CLASS)
    factor = tl.full((), 1.0, like)
    if MEAN:
        if PARTS > 0:
            part = tl.arange(0, PARTS)
            total = tl.sum(tl.load(counted + part, mask=part < parts, other=0.0), 0)
        else:
            sums = tl.zeros((1024,), like)
            for block in range(tl.cdiv(rows, 1024)):
                row = block * 1024 + tl.arange(0, 1024)
                _, each = weight_of(target, class_weight, row, row < rows, ignored, like, CLASSES, HAS_WEIGHT)
                sums += each
            total = tl.sum(sums, 0)
        factor = 1.0 / tl.where(total == 0, 1.0, total)
    upstream_factor = factor
    if UPSTREAM == 1:
        upstream_factor = factor * tl.load(upstream).to(like)
    own_kappa = tl.load(kappa).to(like)
    inverse_kappa = 1.0 / tl.where(own_kappa > 0, own_kappa, 1.0)
    value_sums = tl.zeros((BLOCK_ROW,), like)
    for tile in range(tl.program_id(0), tl.cdiv(rows, BLOCK_ROW), programs):
        row = tl.full((), BLOCK_ROW, tl.int64) * tile + tl.arange(0, BLOCK_ROW)
        mask = row < rows
        label, weight = weight_of(target, class_weight, row, mask, ignored, like, CLASSES, HAS_WEIGHT)
        live = mask & (weight != 0)  # logits of masked rows are not read
        known = live & (weight == weight)
        first = row * CLASSES
        chosen = tl.load(x + first + label, mask=known, other=0.0).to(like)
        if BLOCK_CLASS >= CLASSES:
            inside = live[:, None] & (lane < CLASSES)[None, :]
            logits = tl.load(x + first[:, None] + lane[None, :], mask=inside, other=float("-inf")).to(like)
            most = tl.max(logits, 1)
            most = tl.where(most > float("-inf"), most, 0.0)
            shares = tl.exp(logits - most[:, None])
            total_share = tl.sum(shares, 1)
        else:
            most = tl.full((BLOCK_ROW,), float("-inf"), like)
            total_share = tl.zeros((BLOCK_ROW,), like)
            for start in range(0, CLASSES, BLOCK_CLASS):
                inside = live[:, None] & (start + lane < CLASSES)[None, :]
                logits = tl.load(x + first[:, None] + (start + lane)[None, :], mask=inside, other=float("-inf")).to(
                    like
                )
                higher = tl.maximum(most, tl.max(logits, 1))
                safe = tl.where(higher > float("-inf"), higher, 0.0)
                total_share = total_share * tl.exp(most - safe) + tl.sum(tl.exp(logits - safe[:, None]), 1)
                most = higher
            most = tl.where(most > float("-inf"), most, 0.0)
        total_share = tl.where(live, total_share, 1.0)
        deviance = tl.log(total_share) - (chosen - most)
        minus_x = tl.where(own_kappa > 0, -own_kappa * deviance, 0.0)
        inlier = tl.exp(minus_x)
        near = deviance * series(tl.maximum(minus_x, -0.25), WIDE)
        value = tl.where(minus_x > -0.25, near, inverse_kappa - inverse_kappa * inlier) * weight
        value = tl.where(live, value, 0.0)
        if WRITE_VALUES:
            tl.store(values + row, value.to(values.dtype.element_ty), mask=mask)
        if SUMS:
            value_sums += value
        if WRITE_SLOPES:
            pull = weight * inlier * upstream_factor
            if UPSTREAM == 2:
                pull = pull * tl.load(upstream + row, mask=mask, other=0.0).to(like)
            inverse_total = 1.0 / total_share
            if BLOCK_CLASS >= CLASSES:
                share = shares * inverse_total[:, None] - tl.where(lane[None, :] == label[:, None], 1.0, 0.0)
                slope = tl.where(live[:, None], share * pull[:, None], 0.0)
                inside = mask[:, None] & (lane < CLASSES)[None, :]
                at = slopes + first[:, None] + lane[None, :]
                tl.store(at, slope.to(slopes.dtype.element_ty), mask=inside)
            else:
                for start in range(0, CLASSES, BLOCK_CLASS):
                    index = (start + lane)[None, :]
                    inside = mask[:, None] & (index < CLASSES)
                    logits = tl.load(x + first[:, None] + index, mask=inside & live[:, None], other=0.0).to(like)
                    share = tl.exp(logits - most[:, None]) * inverse_total[:, None]
                    share = share - tl.where(index == label[:, None], 1.0, 0.0)
                    slope = tl.where(live[:, None], share * pull[:, None], 0.0)
                    tl.store(slopes + first[:, None] + index, slope.to(slopes.dtype.element_ty), mask=inside)
    if SUMS:
        tl.store(partial + tl.program_id(0), tl.sum(value_sums, 0) * factor)
