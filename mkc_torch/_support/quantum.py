"""The resolution of recorded numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

_DECIMALS = 7
"""Numbers of a file with fewer decimals than this are taken as rounded."""

_FEWEST = 20
"""Fewest distinct values by which multiples of a step are recognised."""

_DISTINCT = 0.9
"""Largest share of distinct values; those of a ramp without noise are multiples of a step, and all distinct."""

_OFF = 1e-4
"""Distance from a multiple, in steps, that is rounding of the file's numbers."""

_ROUNDED = 1e-12
"""Relative tolerance at which a number counts as rounded."""


def quanta_of(values: Float[Tensor, "N m"]) -> Float[Tensor, " m"]:
    """The resolution of each column: the smallest step between its values, or the last decimal; else 0.

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
    """The smallest step between distinct values of a column; 0 where many are distinct and not multiples of it.

    Example:
        >>> import torch
        >>> _step(0.25 * torch.arange(0.0, 40.0, 0.7).round())
        0.25
    """
    numbers = values.unique()
    if len(numbers) < 2:
        return 0.0
    step = float(numbers.diff().min())
    if len(numbers) < len(values) // 4:
        return step
    multiples = (numbers - numbers[0]) / step
    repeated = _FEWEST <= len(numbers) <= _DISTINCT * len(values)
    return step if repeated and bool(((multiples - multiples.round()).abs() <= _OFF).all()) else 0.0


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
