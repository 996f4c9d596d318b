"""How many steps of integration an interval between samples takes."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["FINEST", "enough_parts"]

FINEST = 8
"""Steps of integration between two samples at most."""

_ROUGH = 0.02
"""Share of an output's spread by which half the step may move it."""


def enough_parts(simulated: Callable[[int], Float[Tensor, "N m"]], measured: Float[Tensor, "N m"]) -> int:
    """The fewest steps between samples of which twice as many change nothing; 1 where no trajectory is found.

    Args:
        simulated: the outputs with so many steps; NaN where no trajectory is found.
        measured: the outputs as recorded.
    """
    parts, before = 1, simulated(1)
    spread = (measured - measured.median(0).values).abs().median(0).values.clamp(min=1e-300)
    while parts < FINEST:
        after = simulated(2 * parts)
        # no trajectory, NaN, may come from steps that are too long
        if bool(((after - before).abs().amax(0) <= _ROUGH * spread).all()):
            break
        parts, before = 2 * parts, after
    return parts if bool(torch.isfinite(before).all()) else 1
