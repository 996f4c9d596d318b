"""Tolerance of the test whether columns are linearly dependent."""

from __future__ import annotations

import torch

_MOST_ROWS = 8192
"""Rows beyond which the tolerance no longer grows: LAPACK adds up blocks of rows, whose errors nearly cancel.

At 1e7 rows of float32 the tolerance would exceed 1, and every matrix would count as dependent."""


def rank_tolerance(num_rows: int, columns: int, dtype: torch.dtype) -> float:
    """Ratio of singular values up to which columns count as dependent.

    Example:
        >>> rank_tolerance(10_000_000, 9, torch.float32) < 1e-3
        True
    """
    return max(min(num_rows, _MOST_ROWS), columns) * torch.finfo(dtype).eps
