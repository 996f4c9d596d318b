"""Affine recurrences of a few states with NumPy, many right-hand sides at once, in a depth of log G."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mkc_torch.simulation.dynamics.compiled.expressions import Array
from mkc_torch.simulation.dynamics.loops.machine_code import machine_code
from mkc_torch.simulation.dynamics.loops.recurrence import pass_on

__all__ = ["Affine", "inverted", "multiplied"]

_FEW = 128
"""Moments up to which every product over 1, 2, 4 ... intervals is kept instead of those of every second moment."""


@dataclass(frozen=True)
class Affine:
    """The recurrence ``δ[k+1] = A[k] δ[k] + v[k+1]``: moment after moment in machine code, or by its products.

    Products over growing intervals: Blelloch, "Prefix Sums and Their Applications" (1990).

    Attributes:
        carries: A of all moments, those of every second moment and so on, (w, w, G) each; 0 where a trajectory begins.
        products: of few moments, over 1, 2, 4 ... intervals.

    Example:
        >>> carries = np.full((1, 1, 4), 0.5)
        >>> carries[..., 0] = 0.0
        >>> Affine.of(carries, 4).solved(np.ones((1, 1, 4)))
        array([[[1.   , 1.5  , 1.75 , 1.875]]])
    """

    carries: tuple[Array, ...]
    products: tuple[Array, ...]

    @classmethod
    def of(cls, carries: Array, longest: int) -> Affine:
        """From A as it arrives at each moment, and the number of moments of the longest trajectory."""
        if machine_code(pass_on) is not None:
            return cls((carries,), ())
        levels = []
        while longest > _FEW:
            levels.append(carries)
            pairs = carries.shape[-1] // 2 * 2
            carries = multiplied(carries[..., 1::2], carries[..., :pairs:2])
            longest = longest // 2 + 1
        products, shift = [], 1
        while shift < longest:
            products.append(carries[..., shift:])
            joined = multiplied(carries[..., shift:], carries[..., :-shift])
            carries = np.concatenate([carries[..., :shift], joined], -1)
            shift *= 2
        return cls(tuple(levels), tuple(products))

    def solved(self, pushed: Array, level: int = 0) -> Array:
        """δ for v, (w, K, G) both."""
        compiled = None if self.products else machine_code(pass_on)
        if compiled is not None:
            values = np.array(pushed, order="C")
            compiled(self.carries[0], values)
            return values
        if level < len(self.carries):
            A, G = self.carries[level], pushed.shape[-1]
            found = np.empty_like(pushed)
            second = pushed[..., 1::2] + multiplied(A[..., 1::2], pushed[..., : G // 2 * 2 : 2])
            second = found[..., 1::2] = self.solved(second, level + 1)
            found[..., 0] = pushed[..., 0]
            found[..., 2::2] = pushed[..., 2::2] + multiplied(A[..., 2::2], second[..., : (G - 1) // 2])
            return found
        values, shift = pushed, 1
        for product in self.products:
            later = values[..., shift:] + multiplied(product, values[..., :-shift])
            values = np.concatenate([values[..., :shift], later], -1)
            shift *= 2
        return values


def multiplied(one: Array, other: Array) -> Array:
    """Matrices of each moment, (i, j, G), times (j, k, G)."""
    if one.shape[1] == 1:
        product: Array = one * other
        return product
    total: Array = one[:, :1] * other[None, 0]
    for j in range(1, one.shape[1]):
        total += one[:, j : j + 1] * other[None, j]
    return total


def inverted(matrices: Array) -> Array:
    """The inverse of each moment's matrix, (n, n, G)."""
    n = len(matrices)
    with np.errstate(all="ignore"):
        if n == 1:
            inverse: Array = 1.0 / matrices
            return inverse
        if n == 2:
            (a, b), (c, d) = matrices
            return np.stack([np.stack([d, -b]), np.stack([-c, a])]) / (a * d - b * c)
    stacked = np.moveaxis(matrices, -1, 0)
    singular = np.logical_not(np.isfinite(stacked).all((1, 2)))
    try:
        found = np.linalg.inv(np.where(singular.reshape(-1, 1, 1), np.eye(n), stacked))
    except np.linalg.LinAlgError:
        found = np.full_like(stacked, np.nan)
    found[singular] = np.nan
    return np.moveaxis(found, 0, -1)
