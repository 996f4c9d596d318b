"""A uniform sample of rows from a stream: the rows with the smallest random keys.

A row's key depends on its number among all rows. The sample is therefore independent of batch sizes and, where every
rank knows its number of rows, of the number of ranks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from mkc_torch.linear._blocks import Block

if TYPE_CHECKING:
    from jaxtyping import Float64, Int64


@dataclass(frozen=True)
class Drawn:
    """Sampled rows with keys and row numbers, in row order; the columns are X, Y and, if given, weights."""

    keys: Float64[np.ndarray, " k"]
    numbers: Int64[np.ndarray, " k"]
    rows: Float64[np.ndarray, "k columns"]

    def smallest(self, size: int) -> Drawn:
        """The rows with the ``size`` smallest keys."""
        if len(self.keys) <= size:
            return self
        chosen = np.sort(np.argpartition(self.keys, size - 1)[:size])
        return Drawn(self.keys[chosen], self.numbers[chosen], self.rows[chosen])


class Reservoir:
    """A uniform sample of at most ``size`` rows.

    Args:
        size: largest number of rows of the sample.
        seed: seed of the keys.
        first: number of rows on the ranks before this one, or None if unknown.
        rank: this rank, which replaces ``first`` if that is unknown.
        rows: number of rows of all ranks, or None if unknown.

    Example:
        >>> sample = Reservoir(3, seed=0)
        >>> for start in (0, 5):
        ...     rows = torch.arange(start, start + 5.0).double()
        ...     sample.add(Block(rows.reshape(5, 1, 1), rows.reshape(5, 1), None))
        >>> sample.drawn().numbers
        array([1, 2, 3])
    """

    def __init__(self, size: int, seed: int, first: int | None = 0, rank: int = 0, rows: int | None = None) -> None:
        bits = np.random.PCG64(seed)
        self._random = np.random.Generator(bits.jumped(rank) if first is None else bits.advance(first))
        self._size, self._keys = size, np.empty(0)
        self._number = first or 0
        self._limit = 1.0 if rows is None else largest_key(size, rows)
        self._parts: list[Drawn] = []
        self._held = 0

    def add(self, block: Block) -> None:
        """Draw from the rows of a block."""
        count = block.y.shape[0]
        if len(self._keys) < count:
            self._keys = np.empty(count)
        keys = self._random.random(out=self._keys[:count])
        chosen = np.flatnonzero(keys < self._limit)
        if len(chosen):
            index = torch.from_numpy(chosen).to(block.y.device)
            parts = [block.rows.flatten(1), block.y] + ([] if block.weight is None else [block.weight])
            rows = torch.cat([part[index] for part in parts], 1).cpu().numpy()
            self._parts.append(Drawn(keys[chosen], self._number + chosen, rows))
            self._held += len(chosen)
        self._number += count
        if self._held > 2 * self._size:
            self._shrink()

    def drawn(self) -> Drawn | None:
        """The sample; None if there were no rows."""
        if self._parts:
            self._shrink()
        return self._parts[0] if self._parts else None

    def _shrink(self) -> None:
        kept = _joined(self._parts).smallest(self._size)
        self._parts, self._held = [kept], len(kept.keys)
        if self._held == self._size:
            self._limit = float(kept.keys.max())


def largest_key(size: int, rows: int) -> float:
    """Limit of the ``size`` smallest keys of ``rows`` rows, six standard deviations above the expected key.

    At worst the sample is slightly too small.
    """
    return (size + 6.0 * math.sqrt(size)) / rows if rows > size else 1.0


def merged(parts: list[Drawn], size: int) -> Drawn:
    """Merge the samples of parts of the rows, in the order of the parts."""
    return _joined(parts).smallest(size)


def _joined(parts: list[Drawn]) -> Drawn:
    return Drawn(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("keys", "numbers", "rows")))
