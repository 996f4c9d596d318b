"""Fixed scattered values, to compare a user's functions at."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor


def scattered(rows: int, count: int) -> Float[Tensor, "rows count"]:
    """Fixed scattered values from 0.1 to 1.1, without the random number generator.

    Example:
        >>> scattered(20, 3).shape, bool((scattered(20, 3) >= 0.1).all())
        (torch.Size([20, 3]), True)
    """
    turns = (
        torch.arange(1, rows + 1, dtype=torch.float64).unsqueeze(-1)
        * (torch.arange(count, dtype=torch.float64) + 2.7).sqrt()
    )
    return turns.remainder(1.0) + 0.1
