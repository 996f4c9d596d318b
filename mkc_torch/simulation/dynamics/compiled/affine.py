"""Solve affine recurrences of a few states with NumPy, many right-hand sides at once, in a depth of log G."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mkc_torch.simulation.dynamics.compiled.expressions import Array
from mkc_torch.simulation.dynamics.loops.machine_code import machine_code
from mkc_torch.simulation.dynamics.loops.recurrence import pass_on, pass_on_many

_FEW = 128
"""Number of grid times up to which products over 1, 2, 4 ... intervals replace halving."""

_MANY = 6
"""Number of states from which their values at a grid time are neighbours in memory."""


@dataclass(frozen=True)
class Affine:
    """The recurrence ``δ[k+1] = A[k] δ[k] + v[k+1]``, solved sequentially by machine code, or in parallel by NumPy.

    Parallel composition: Blelloch, "Prefix Sums and Their Applications" (1990).

    Attributes:
        carries: A at all grid times, at every second time, and so on, (w, w, G) each; 0 where a trajectory starts.
        products: products of A over 1, 2, 4 ... intervals at the last level.

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
        """Compose from A into each grid time, and the number of grid times of the longest trajectory."""
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

    def solved(self, source: Array, level: int = 0) -> Array:
        """Solve for δ given v, (w, K, G) each."""
        many = None if self.products or len(source) < _MANY else machine_code(pass_on_many)
        if many is not None:
            by_time = np.array(np.moveaxis(source, -1, 0), order="C")
            many(self._by_time, by_time)
            return np.moveaxis(by_time, 0, -1)
        compiled = None if self.products else machine_code(pass_on)
        if compiled is not None:
            values = np.array(source, order="C")
            compiled(self.carries[0], values)
            return values
        if level < len(self.carries):
            A, G = self.carries[level], source.shape[-1]
            found = np.empty_like(source)
            second = source[..., 1::2] + multiplied(A[..., 1::2], source[..., : G // 2 * 2 : 2])
            second = found[..., 1::2] = self.solved(second, level + 1)
            found[..., 0] = source[..., 0]
            found[..., 2::2] = source[..., 2::2] + multiplied(A[..., 2::2], second[..., : (G - 1) // 2])
            return found
        values, shift = source, 1
        for product in self.products:
            later = values[..., shift:] + multiplied(product, values[..., :-shift])
            values = np.concatenate([values[..., :shift], later], -1)
            shift *= 2
        return values

    @cached_property
    def _by_time(self) -> Array:
        return np.ascontiguousarray(np.moveaxis(self.carries[0], -1, 0))


def multiplied(left: Array, right: Array) -> Array:
    """Matrix product at each grid time, (i, j, G) times (j, k, G)."""
    if left.shape[1] == 1:
        product: Array = left * right
        return product
    total: Array = left[:, :1] * right[None, 0]
    for j in range(1, left.shape[1]):
        total += left[:, j : j + 1] * right[None, j]
    return total


def inverted(matrices: Array) -> Array:
    """Inverse of the matrix at each grid time, (n, n, G); NaN where singular."""
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
