"""Running medians over long windows."""

from __future__ import annotations

from bisect import bisect_left, insort
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["running_median"]


def running_median(values: Float[Tensor, "N m"], half: int) -> Float[Tensor, "N m"]:
    """Return the median of each value and ``half`` neighbours to either side, mirrored at the ends.

    The window is kept sorted: each new sample is inserted, and the oldest is removed.

    Args:
        values: finite values.
        half: 0 or more, and fewer than N.

    Example:
        >>> running_median(torch.tensor([[1.0], [9.0], [2.0], [3.0]]), 1).flatten()
        tensor([9., 2., 3., 2.])
    """
    padded = torch.nn.functional.pad(values.mT, (half, half), mode="reflect")
    return torch.tensor([_medians(channel, half) for channel in padded.tolist()], dtype=values.dtype).mT


def _medians(padded: list[float], half: int) -> list[float]:
    width = 2 * half + 1
    window = sorted(padded[:width])
    found = [window[half]]
    for leaves, comes in zip(padded, padded[width:], strict=False):
        del window[bisect_left(window, leaves)]
        insort(window, comes)
        found.append(window[half])
    return found
