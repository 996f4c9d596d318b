"""Convert tensors to the plain numbers of a result, and measure the size of residuals."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from torch import Tensor

from mkc_torch.calibration.file import Matrix, Vector

if TYPE_CHECKING:
    from jaxtyping import Float


class ResidualSpread(NamedTuple):
    """The size of residuals: 1.4826 times their median absolute value, and their root mean square."""

    robust: float
    rms: float


def spread_of(residual: Float[Tensor, " N"]) -> ResidualSpread:
    """The size of residuals.

    Example:
        >>> import torch
        >>> spread_of(torch.tensor([4.0, -2.0, 2.0, -4.0, 1.0, 0.0, 2.0, 2.0])).robust
        2.9652
    """
    return ResidualSpread(1.4826 * float(residual.abs().median()), float(residual.square().mean().sqrt()))


def vector_of(values: Float[Tensor, " 3"]) -> Vector:
    """The three numbers of a tensor."""
    x, y, z = values.tolist()
    return x, y, z


def matrix_of(values: Float[Tensor, "3 3"]) -> Matrix:
    """The rows of a tensor."""
    a, b, c = values
    return vector_of(a), vector_of(b), vector_of(c)
