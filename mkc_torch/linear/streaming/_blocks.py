"""Batches as float64 blocks that fit a processor's cache, each checked for type and shape."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.arguments import format_value
from mkc_torch._support.arrays import as_tensor, is_array

if TYPE_CHECKING:
    from jaxtyping import Float64, Shaped

BLOCK_VALUES = 80_000
"""Largest number of values in a block: 640 kB in float64, which stay in a cache of 1 MB during some ten operations.

Chosen where rows of nine values were fastest, at 4000 to 8000 rows."""

_LEAST_ROWS = 64
"""Least number of rows in a block."""


@dataclass(frozen=True)
class StreamBlock:
    """Rows of one batch in float64, with the number of the batch, the first row in it, and whether it is float32.

    Each column is contiguous; products of columns and their sums then take a third of the time.
    """

    joined: Float64[np.ndarray, "m n+1 B"]
    weight: Float64[np.ndarray, "m B"] | None
    batch: int = 0
    first: int = 0
    single: bool = False

    @property
    def X(self) -> Float64[np.ndarray, "m n B"]:  # noqa: N802
        return self.joined[:, :-1]

    @property
    def Y(self) -> Float64[np.ndarray, "m B"]:  # noqa: N802
        return self.joined[:, -1]


@dataclass(frozen=True)
class Shape:
    """Shape of all batches of a stream: m channels of n columns, whether one-channel input, whether weighted."""

    m: int
    n: int
    single_channel: bool
    weighted: bool


def checked_source(batches: object) -> Iterable[Any]:
    """Return ``batches`` if it can be iterated over repeatedly, else raise.

    Raises:
        TypeError: it cannot, or it is a single batch.
    """
    if isinstance(batches, Tensor) or is_array(batches):
        raise TypeError(
            f"Expected argument `batches` to yield batches (X, Y) but got {type(batches).__name__}; split arrays into "
            "batches by from_memmap(X, Y)."
        )
    if isinstance(batches, Iterator):
        raise TypeError(
            f"Expected argument `batches` to be an iterable that can be read again in every pass but got "
            f"{format_value(batches)}, which can be read once; pass a DataLoader, a list, from_memmap(X, Y), or an "
            "object whose __iter__ is a generator function."
        )
    if not hasattr(batches, "__iter__"):
        raise TypeError(
            f"Expected argument `batches` to be an iterable of (X, Y) but got {format_value(batches)}; pass a "
            "DataLoader or a list of batches."
        )
    return batches


def blocks(batches: Iterable[Any], shape: Shape | None = None) -> Iterator[tuple[Shape, StreamBlock]]:
    """Yield the blocks of one pass over the batches; the memory of a block is reused for the next.

    Args:
        batches: iterable of (X, Y) or (X, Y, weight).
        shape: required shape of all batches; None takes that of the first.

    Raises:
        TypeError: a batch is not a pair or triple of arrays of real numbers.
        ValueError: a batch has a wrong number of columns, channels or rows.
    """
    buffer = np.empty(0)
    for number, batch in enumerate(batches):
        X, Y, weight = _arrays(batch, number)
        shape = _checked_shape(X, Y, weight, number, shape)
        rows = max(_LEAST_ROWS, BLOCK_VALUES // (shape.m * (shape.n + 1)))
        if buffer.size == 0:
            buffer = np.empty(rows * shape.m * (shape.n + 1))
        for first in range(0, len(X), rows):
            part = slice(first, first + rows)
            joined = _filled(buffer, X[part], Y[part], shape)
            single = X.dtype == Y.dtype == np.float32
            yield shape, StreamBlock(joined, _weights(weight, part, shape), number, first, single)


def pieces(
    batches: Iterable[Any], shape: Shape, rows: int
) -> Iterator[tuple[Shaped[np.ndarray, "B m n"], Shaped[np.ndarray, "B m"], Shaped[np.ndarray, "B m"] | None]]:
    """Yield arrays of ``rows`` rows in one pass over the batches, without a copy.

    Raises:
        TypeError, ValueError: as :func:`blocks`.
    """
    for number, batch in enumerate(batches):
        arrays = _arrays(batch, number)
        _checked_shape(*arrays, number, shape)
        x, y, weight = (None if a is None else a[:, None] if a.ndim == 1 else a for a in arrays)
        assert x is not None
        assert y is not None
        x = x[:, None] if x.ndim == 2 else x
        weight = None if weight is None else np.broadcast_to(weight, y.shape)
        for first in range(0, len(x), rows):
            part = slice(first, first + rows)
            yield x[part], y[part], None if weight is None else weight[part]


def _arrays(batch: Any, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    if not isinstance(batch, (tuple, list)) or len(batch) not in (2, 3):
        kind = (
            f"{type(batch).__name__} of {len(batch)}" if isinstance(batch, (tuple, list, dict)) else format_value(batch)
        )
        raise TypeError(
            f"Expected every batch to be (X, Y) or (X, Y, weight) but got {kind} as batch {number}; yield tuples of "
            "arrays."
        )
    names = ("X", "Y", "weight")
    x, y, *rest = (_array(f"{name} of batch {number}", value) for name, value in zip(names, batch, strict=False))
    return x, y, rest[0] if rest else None


def _array(name: str, value: Any) -> np.ndarray:
    """The values as an array, without a copy where possible."""
    if isinstance(value, np.ndarray) and value.dtype in (np.float32, np.float64):
        # slicing a memmap takes ten times as long as slicing a plain array
        return np.asarray(value)
    tensor = value if isinstance(value, Tensor) else as_tensor(name, value)
    if tensor.is_complex():
        raise TypeError(f"Expected argument `{name}` to be real but got {tensor.dtype}; pass its real part.")
    tensor = tensor.detach().cpu()
    return tensor.float().numpy() if tensor.dtype == torch.bfloat16 else tensor.numpy()


def _checked_shape(X: np.ndarray, Y: np.ndarray, weight: np.ndarray | None, number: int, shape: Shape | None) -> Shape:
    if X.ndim not in (2, 3) or Y.shape != X.shape[:-1] or X.shape[-1] == 0 or (X.ndim == 3 and X.shape[1] == 0):
        remedy = "; one channel is Y.squeeze(-1)" if X.ndim == 2 and Y.shape == (len(X), 1) else ""
        raise ValueError(
            f"Expected `X` (N, n) with `Y` (N,), or (N, m, n) with (N, m), but got {X.shape} and {Y.shape} in batch "
            f"{number}{remedy}."
        )
    if weight is not None and weight.shape not in ((len(X),), Y.shape):
        raise ValueError(
            f"Expected weights of shape ({len(X)},) or {Y.shape} but got {weight.shape} in batch {number}."
        )
    found = Shape(X.shape[1] if X.ndim == 3 else 1, X.shape[-1], X.ndim == 2, weight is not None)
    if shape is not None and found != shape:
        raise ValueError(
            f"Expected every batch like the first, {_of(shape)}, but got {_of(found)} in batch {number}; yield the "
            "same columns in every batch."
        )
    return found


def _of(shape: Shape) -> str:
    channels = "" if shape.single_channel else f"{shape.m} channels of "
    return f"{channels}{shape.n} columns {'with' if shape.weighted else 'without'} weights"


def _filled(buffer: np.ndarray, X: np.ndarray, Y: np.ndarray, shape: Shape) -> np.ndarray:
    """X and Y in float64 in the buffer: each column is a row of it, and Y of a channel follows its X."""
    count, m, n = len(X), shape.m, shape.n
    joined = buffer[: m * (n + 1) * count].reshape(m, n + 1, count)
    np.copyto(joined[:, :n], X.reshape(count, m, n).transpose(1, 2, 0))
    np.copyto(joined[:, n], Y.reshape(count, m).T)
    return joined


def _weights(weight: np.ndarray | None, part: slice, shape: Shape) -> np.ndarray | None:
    if weight is None:
        return None
    own = weight[part].astype(np.float64)
    return np.ascontiguousarray(np.broadcast_to(own.T, (shape.m, len(own))))
