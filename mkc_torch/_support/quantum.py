"""The step of numbers that were recorded in steps."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["quanta_of", "rounding_of"]

_DECIMALS = 7
"""Decimals up to which the numbers of a file are taken for rounded ones."""

_ROUNDED = 1e-12
"""Of a number: by so much a rounded one may be off."""


def quanta_of(values: Float[Tensor, "N m"]) -> Float[Tensor, " m"]:
    """The step of each column: between the few numbers that it has, or the last decimal of a file; 0 for none.

    Example:
        >>> import torch
        >>> values = torch.tensor([[20.31, 0.123456789], [20.34, 0.523456789]], dtype=torch.float64)
        >>> quanta_of(values).tolist()
        [0.01, 0.0]
    """
    return values.new_tensor([max(_step(one), _resolution(one)) for one in values.unbind(-1)])


def rounding_of(values: Float[Tensor, "N m"]) -> Float[Tensor, " m"]:
    """Standard deviation of what rounding to those steps adds to each column: a twelfth of their square, as a root."""
    return quanta_of(values) / 12.0**0.5


def _step(values: Float[Tensor, " N"]) -> float:
    """Smallest step between two numbers that a column has; 0 where nearly all numbers are different."""
    numbers = values.unique()
    few = len(numbers) < len(values) // 4 and len(numbers) > 1
    return float(numbers.diff().min()) if few else 0.0


def _resolution(values: Float[Tensor, " N"]) -> float:
    """The quantum of numbers that a file has with a few decimals; 0 where they have more than a few.

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
