"""A uniform sample of rows, drawn while they stream by: those with the smallest of random keys.

The keys are a row's by its number among all rows, so neither the sizes of batches nor, where every rank knows how many
rows it has, the number of ranks changes which are drawn.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float64, Int64

    from mkc_torch.linear.streaming._blocks import StreamBlock

__all__ = ["Drawn", "Reservoir", "merged"]


@dataclass(frozen=True)
class Drawn:
    """Rows with their keys and numbers, in the order of rows; columns are X, Y and, with weights, these."""

    keys: Float64[np.ndarray, " k"]
    numbers: Int64[np.ndarray, " k"]
    rows: Float64[np.ndarray, "k columns"]

    def smallest(self, size: int) -> Drawn:
        """Those of the smallest keys."""
        if len(self.keys) <= size:
            return self
        chosen = np.sort(np.argpartition(self.keys, size - 1)[:size])
        return Drawn(self.keys[chosen], self.numbers[chosen], self.rows[chosen])


class Reservoir:
    """At most ``size`` rows, each of all rows as likely as another.

    Args:
        size: of the sample.
        seed: of the keys.
        first: the number of the rows before this rank's, where it is known.
        rank: stands for it where it is not.

    Example:
        >>> from mkc_torch.linear.streaming._blocks import StreamBlock
        >>> sample = Reservoir(3, seed=0)
        >>> for start in (0, 5):
        ...     rows = np.arange(start, start + 5.0)
        ...     sample.add(StreamBlock(np.stack([rows, rows])[None], None))
        >>> sample.drawn().numbers
        array([1, 2, 3])
    """

    def __init__(self, size: int, seed: int, first: int | None = 0, rank: int = 0) -> None:
        bits = np.random.PCG64(seed)
        self._random = np.random.Generator(bits.jumped(rank) if first is None else bits.advance(first))
        self._size = size
        self._number = first or 0
        self._limit = 1.0
        self._parts: list[Drawn] = []
        self._held = 0

    def add(self, block: StreamBlock) -> None:
        """Look at the rows of a block."""
        count = block.Y.shape[-1]
        keys = self._random.random((count,))
        chosen = np.flatnonzero(keys < self._limit)
        if len(chosen):
            parts: list[np.ndarray] = [block.X.reshape(-1, count), block.Y]
            parts += [] if block.weight is None else [block.weight]
            rows = np.concatenate([part[:, chosen] for part in parts]).T
            self._parts.append(Drawn(keys[chosen], self._number + chosen, rows))
            self._held += len(chosen)
        self._number += count
        if self._held > 2 * self._size:
            self._shrink()

    def drawn(self) -> Drawn | None:
        """The sample; None of no rows."""
        if self._parts:
            self._shrink()
        return self._parts[0] if self._parts else None

    def _shrink(self) -> None:
        kept = _joined(self._parts).smallest(self._size)
        self._parts, self._held = [kept], len(kept.keys)
        if self._held == self._size:
            self._limit = float(kept.keys.max())


def merged(parts: list[Drawn], size: int) -> Drawn:
    """The sample of all rows from those of parts of them, in the order of the parts."""
    return _joined(parts).smallest(size)


def _joined(parts: list[Drawn]) -> Drawn:
    return Drawn(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("keys", "numbers", "rows")))
