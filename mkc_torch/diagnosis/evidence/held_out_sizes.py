"""Residuals of each output on held-out blocks, without the blocks in which an open-loop simulation diverges."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.evidence.held_out import Evidence, HeldOutBlocks
from mkc_torch.diagnosis.goodness_of_fit import size_of
from mkc_torch.diagnosis.result import DivergedBlock, ResidualSizes
from mkc_torch.simulation.protocol import PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Bool

__all__ = ["kept_blocks", "sizes_of"]

_RANGE = 1.0
"""Residual, in ranges of the recorded output, beyond which a sample has diverged."""

_MOST_DIVERGED = 0.2
"""Share of diverged samples above which a block has diverged; a few outliers are no divergence."""


def kept_blocks(
    prepared: PreparedSimulation, models: Sequence[Evidence], blocks: HeldOutBlocks
) -> tuple[Bool[Tensor, " N"], list[list[int]]]:
    """Return the samples of blocks in which no model diverges, and each model's diverged blocks, from 0."""
    known = prepared.measured
    count = int(blocks.block.max()) + 1
    kept = torch.ones_like(blocks.block, dtype=torch.bool)
    diverged = []
    for model in models:
        residual = model.residual
        if known.shape == residual.shape:
            reach = _RANGE * (known.amax(0) - known.amin(0))
            out = ~(residual.abs() <= reach) & (reach > 0)
        else:
            out = ~residual.isfinite()
        many = torch.zeros(count).index_add(0, blocks.block, out.any(-1).float())
        size = torch.zeros(count).index_add(0, blocks.block, torch.ones(len(out)))
        gone = many > _MOST_DIVERGED * size
        diverged.append(gone.nonzero().squeeze(-1).tolist())
        kept &= ~gone[blocks.block]
    return kept, diverged


def sizes_of(
    prepared: PreparedSimulation, units: Sequence[str], before: Evidence, after: Evidence, blocks: HeldOutBlocks
) -> tuple[dict[str, ResidualSizes], tuple[DivergedBlock, ...]]:
    """Return each output's residual before and after, in its unit, and the diverged blocks, which are excluded."""
    kept, (lost_before, lost_after) = kept_blocks(prepared, (before, after), blocks)
    diverged = tuple(
        DivergedBlock(block + 1, block in lost_before, block in lost_after)
        for block in sorted({*lost_before, *lost_after})
    )
    if not bool(kept.any()):
        return {}, diverged
    size_before, size_after = size_of(before.residual[kept]), size_of(after.residual[kept])
    return {
        name: ResidualSizes(float(size_before[k]), float(size_after[k]), units[k])
        for k, name in enumerate(prepared.channels)
    }, diverged
