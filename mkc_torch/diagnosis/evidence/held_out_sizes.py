"""Residuals of each output on blocks that fits have not seen, without blocks in which a free run is lost."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.evidence.held_out import Evidence, HeldOutBlocks
from mkc_torch.diagnosis.goodness_of_fit import size_of
from mkc_torch.diagnosis.result import ResidualSizes
from mkc_torch.simulation.protocol import PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Bool

__all__ = ["kept_blocks", "left_in_words", "sizes_of"]

_RANGE = 1.0
"""Times an output's range that a residual is off where its free run has left the recording."""


def kept_blocks(
    prepared: PreparedSimulation, models: Sequence[Evidence], blocks: HeldOutBlocks
) -> tuple[Bool[Tensor, " N"], list[int]]:
    """The samples of blocks in which no model's run is lost, and in how many blocks each model's is."""
    known: Tensor | None = getattr(prepared, "measured", None)
    count = int(blocks.block.max()) + 1
    kept = torch.ones_like(blocks.block, dtype=torch.bool)
    lost = []
    for model in models:
        residual = model.residual
        if known is not None and known.shape == residual.shape:
            reach = _RANGE * (known.amax(0) - known.amin(0))
            out = ~(residual.abs() <= reach) & (reach > 0)
        else:
            out = ~residual.isfinite()
        # an outlier is a sample or two
        many = torch.zeros(count).index_add(0, blocks.block, out.any(-1).float())
        size = torch.zeros(count).index_add(0, blocks.block, torch.ones(len(out)))
        gone = many > 0.2 * size
        lost.append(int(gone.sum()))
        kept &= ~gone[blocks.block]
    return kept, lost


def sizes_of(
    prepared: PreparedSimulation, units: Sequence[str], before: Evidence, after: Evidence, blocks: HeldOutBlocks
) -> tuple[dict[str, ResidualSizes], str]:
    """Each output's residual before and after, in its own unit; and what is to be said of blocks that were lost."""
    kept, lost = kept_blocks(prepared, (before, after), blocks)
    told = left_in_words(lost, int(blocks.block.max()) + 1)
    if not bool(kept.any()):
        return {}, told
    one, other = size_of(before.residual[kept]), size_of(after.residual[kept])
    return {
        name: ResidualSizes(float(one[k]), float(other[k]), units[k]) for k, name in enumerate(prepared.channels)
    }, told


def left_in_words(lost: Sequence[int], count: int) -> str:
    """What is to be said of blocks in which a free run leaves the recording's range; empty where none does.

    Example:
        >>> left_in_words([0, 0], 25), left_in_words([3, 0], 25)
        ('', 'In 3 of 25 blocks the simulation alone leaves the range of the recording; they enter no mean.')
    """
    before, after = lost
    if before and after:
        who = f"In {before} of {count} blocks the simulation alone leaves the range of the recording, in {after} the"
        who += " corrected one"
    elif before:
        who = f"In {before} of {count} blocks the simulation alone leaves the range of the recording"
    elif after:
        who = f"In {after} of {count} blocks the corrected simulation leaves the range of the recording"
    else:
        return ""
    return f"{who}; they enter no mean."
