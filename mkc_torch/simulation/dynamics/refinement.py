"""Choose the number of integration steps between samples."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

FINEST = 8
"""Integration steps between two samples at most."""

_ROUGH = 0.02
"""Largest change of an output when the step is halved, as a share of its median absolute deviation."""


def enough_parts(simulated: Callable[[int], Float[Tensor, "N m"]], measured: Float[Tensor, "N m"]) -> int:
    """The smallest number of steps between samples that doubling no longer changes; 1 where no trajectory is found.

    Args:
        simulated: the outputs by the number of steps; NaN where no trajectory is found.
        measured: (N, m), the recorded outputs.
    """
    parts, before = 1, simulated(1)
    spread = (measured - measured.median(0).values).abs().median(0).values.clamp(min=1e-300)
    while parts < FINEST:
        after = simulated(2 * parts)
        # NaN, no trajectory, fails this test: the steps may be too long
        if bool(((after - before).abs().amax(0) <= _ROUGH * spread).all()):
            break
        parts, before = 2 * parts, after
    return parts if bool(torch.isfinite(before).all()) else 1
