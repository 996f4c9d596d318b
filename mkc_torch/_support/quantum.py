"""The resolution of recorded numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

_DECIMALS = 7
"""Numbers of a file with fewer decimals than this are taken as rounded."""

_ROUNDED = 1e-12
"""Relative tolerance at which a number counts as rounded."""


def quanta_of(values: Float[Tensor, "N m"]) -> Float[Tensor, " m"]:
    """The resolution of each column: the smallest step between few distinct values, or the last decimal; else 0.

    Example:
        >>> import torch
        >>> values = torch.tensor([[20.31, 0.123456789], [20.34, 0.523456789]], dtype=torch.float64)
        >>> quanta_of(values).tolist()
        [0.01, 0.0]
    """
    return values.new_tensor([max(_step(column), _resolution(column)) for column in values.unbind(-1)])


def rounding_of(values: Float[Tensor, "N m"]) -> Float[Tensor, " m"]:
    """The standard deviation of the rounding error of each column: its resolution over √12."""
    return quanta_of(values) / 12.0**0.5


def _step(values: Float[Tensor, " N"]) -> float:
    """The smallest step between distinct values of a column; 0 where nearly all values are distinct."""
    numbers = values.unique()
    few = len(numbers) < len(values) // 4 and len(numbers) > 1
    return float(numbers.diff().min()) if few else 0.0


def _resolution(values: Float[Tensor, " N"]) -> float:
    """The last decimal of numbers with few decimals; 0 for more decimals.

    Example:
        >>> import torch
        >>> _resolution(torch.tensor([98.2, 94.4, 91.4], dtype=torch.float64))
        0.1
    """
    for decimals in range(_DECIMALS):
        scaled = values * 10.0**decimals
        if bool(((scaled - scaled.round()).abs() <= _ROUNDED * scaled.abs().clamp(min=1.0)).all()):
            return float(10.0**-decimals)
    return 0.0
