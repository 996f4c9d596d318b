"""Batches as rows of one problem, each checked for type and shape."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from mkc_torch._support.arguments import format_value
from mkc_torch._support.arrays import as_tensor, is_array
from mkc_torch.linear._rows import Rows

if TYPE_CHECKING:
    from jaxtyping import Float64


@dataclass(frozen=True)
class Shape:
    """Shape of all batches of a stream: m channels of n columns, whether one-channel input, whether weighted."""

    m: int
    n: int
    single_channel: bool
    weighted: bool


def checked_source(batches: object) -> Iterable[Any]:
    """Return ``batches`` as an iterable that can be read in every pass, else raise.

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
    if callable(batches) and not hasattr(batches, "__iter__"):
        return _Called(batches)
    if not hasattr(batches, "__iter__"):
        raise TypeError(
            f"Expected argument `batches` to be an iterable of (X, Y) but got {format_value(batches)}; pass a "
            "DataLoader, a list of batches, or a function that yields them."
        )
    return batches


class _Called:
    """Batches that a function yields, called in every pass."""

    def __init__(self, function: Callable[[], Iterable[Any]]) -> None:
        self._function = function

    def __iter__(self) -> Iterator[Any]:
        return iter(self._function())


def rows_of(
    batches: Iterable[Any], shape: Shape | None = None, frame: Float64[Tensor, "n n"] | None = None
) -> Iterator[tuple[Shape, Rows]]:
    """Yield the rows of each batch that has any, without a copy.

    Args:
        batches: iterable of (X, Y) or (X, Y, weight).
        shape: required shape of all batches; None takes that of the first.
        frame: change of basis of the columns.

    Raises:
        TypeError: a batch is not a pair or triple of arrays of real numbers.
        ValueError: a batch has a wrong number of columns, channels or rows.
    """
    for number, batch in enumerate(batches):
        X, Y, weight = _arrays(batch, number)
        shape = _checked_shape(X, Y, weight, number, shape)
        y = Y.reshape(len(Y), shape.m)
        if weight is not None:
            own = weight.reshape(len(Y), -1)
            weight = own.expand(y.shape) if isinstance(own, Tensor) else np.broadcast_to(own, y.shape)
        yield shape, Rows(X.reshape(len(X), shape.m, shape.n), y, weight, frame)


def _arrays(batch: Any, number: int) -> tuple[Any, Any, Any]:
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


def _array(name: str, value: Any) -> Any:
    """The values as an array or a tensor, without a copy where possible."""
    if isinstance(value, np.ndarray) and value.dtype in (np.float32, np.float64):
        # slicing a memmap takes ten times as long as slicing a plain array
        return np.asarray(value)
    tensor = value if isinstance(value, Tensor) else as_tensor(name, value)
    if tensor.is_complex():
        raise TypeError(f"Expected argument `{name}` to be real but got {tensor.dtype}; pass its real part.")
    return tensor.detach()


def _checked_shape(X: Any, Y: Any, weight: Any, number: int, shape: Shape | None) -> Shape:
    if X.ndim not in (2, 3) or Y.shape != X.shape[:-1] or X.shape[-1] == 0 or (X.ndim == 3 and X.shape[1] == 0):
        remedy = "; one channel is Y.squeeze(-1)" if X.ndim == 2 and Y.shape == (len(X), 1) else ""
        raise ValueError(
            f"Expected `X` (N, n) with `Y` (N,), or (N, m, n) with (N, m), but got {tuple(X.shape)} and "
            f"{tuple(Y.shape)} in batch {number}{remedy}."
        )
    if weight is not None and weight.shape not in ((len(X),), Y.shape):
        raise ValueError(
            f"Expected weights of shape ({len(X)},) or {tuple(Y.shape)} but got {tuple(weight.shape)} in batch "
            f"{number}."
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
