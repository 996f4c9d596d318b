"""Torch's shape operations, and sums and products over channels, on a symbol's expressions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mkc_torch.simulation.dynamics.compiled.expressions import Expressions
from mkc_torch.simulation.dynamics.compiled.symbol import Nodes, Symbol, UntraceableError, as_nodes


def _axis(dim: int, count: int) -> int:
    return dim + count if dim < 0 else dim


def _other_axis(symbol: Symbol, dim: int) -> int:
    """The index of an axis; raise where it is the time axis."""
    axis = _axis(dim, symbol.dim())
    if axis == symbol.time_axis or symbol.packed is not None:
        raise UntraceableError("an operation along the time axis")
    return axis


def _unchanged(symbol: Symbol, *_: Any, **__: Any) -> Symbol:
    """A new symbol with the same values."""
    return Symbol(symbol.tracing, symbol.nodes, symbol.shape, symbol.time_axis, symbol.dtype, symbol.packed)


def _filled(value: float) -> Callable[..., Any]:
    def like(symbol: Symbol, **_: Any) -> Symbol:
        if symbol.packed is not None:
            raise UntraceableError("flattened channels")
        nodes = np.full(symbol.nodes.shape, symbol.expressions.number(value), dtype=np.int64)
        return Symbol(symbol.tracing, nodes, tuple(symbol.shape), symbol.time_axis)

    return like


def _full_like(symbol: Symbol, value: float, **_: Any) -> Any:
    return _filled(float(value))(symbol)


def _new(value: float) -> Callable[..., Tensor]:
    def made(_: Symbol, size: Sequence[int], **named: Any) -> Tensor:
        return torch.full(tuple(size), value, dtype=named.get("dtype") or torch.float64)

    return made


def _new_full(_: Symbol, size: Sequence[int], value: float, **named: Any) -> Tensor:
    return torch.full(tuple(size), value, dtype=named.get("dtype") or torch.float64)


def _view(symbol: Symbol, size: Sequence[int]) -> Symbol:
    shape = list(size)
    if -1 in shape:
        shape[shape.index(-1)] = symbol.numel() // max(1, -math.prod(shape))
    if symbol.packed is not None:
        if len(shape) != 2 or shape[0] not in symbol.tracing.lengths:
            raise UntraceableError("flattened channels")
        matrix, nodes = symbol.packed
        product = _product(symbol, matrix.unflatten(0, shape), nodes)
        return symbol.like(product, shape, 0)
    if symbol.time_axis is None:
        return symbol.like(symbol.nodes.reshape(shape), shape, None)
    before, length = math.prod(symbol.shape[: symbol.time_axis]), symbol.shape[symbol.time_axis]
    places = [k for k, size in enumerate(shape) if size == length and math.prod(shape[:k]) == before]
    if not places:
        raise UntraceableError("a view that mixes the time axis with others")
    nodes = symbol.nodes.reshape([1 if k == places[0] else size for k, size in enumerate(shape)])
    return symbol.like(nodes, shape, places[0])


def _unsqueeze(symbol: Symbol, dim: int) -> Symbol:
    if symbol.packed is not None:
        raise UntraceableError("flattened channels")
    axis = _axis(dim, symbol.dim() + 1)
    time_axis = None if symbol.time_axis is None else symbol.time_axis + (symbol.time_axis >= axis)
    shape = [*symbol.shape[:axis], 1, *symbol.shape[axis:]]
    return symbol.like(np.expand_dims(symbol.nodes, axis), shape, time_axis)


def _squeeze(symbol: Symbol, dim: int | Sequence[int] | None = None) -> Symbol:
    if dim is None:
        dims = list(range(symbol.dim()))
    else:
        dims = [_axis(k, symbol.dim()) for k in ((dim,) if isinstance(dim, int) else dim)]
    gone = tuple(k for k in dims if symbol.shape[k] == 1 and k != symbol.time_axis)
    time_axis = None if symbol.time_axis is None else symbol.time_axis - sum(k < symbol.time_axis for k in gone)
    return symbol.like(symbol.nodes.squeeze(gone), [n for k, n in enumerate(symbol.shape) if k not in gone], time_axis)


def _select(symbol: Symbol, dim: int, index: int) -> Symbol:
    axis = _other_axis(symbol, dim)
    time_axis = None if symbol.time_axis is None else symbol.time_axis - (symbol.time_axis > axis)
    shape = [*symbol.shape[:axis], *symbol.shape[axis + 1 :]]
    return symbol.like(np.asarray(symbol.nodes.take(index, axis)), shape, time_axis)


def _slice(symbol: Symbol, dim: int = 0, start: int | None = None, end: int | None = None, step: int = 1) -> Symbol:
    axis = _axis(dim, symbol.dim())
    kept = range(symbol.shape[axis])[slice(start, end, step)]
    if len(kept) == symbol.shape[axis] and step == 1:
        return _unchanged(symbol)
    axis = _other_axis(symbol, axis)
    nodes = symbol.nodes[(slice(None),) * axis + (slice(start, end, step),)]
    shape = [*symbol.shape[:axis], len(kept), *symbol.shape[axis + 1 :]]
    return symbol.like(nodes, shape, symbol.time_axis)


def _unbind(symbol: Symbol, dim: int = 0) -> list[Symbol]:
    axis = _other_axis(symbol, dim)
    return [_select(symbol, axis, k) for k in range(symbol.shape[axis])]


def _split(symbol: Symbol, sizes: int | Sequence[int], dim: int = 0) -> list[Symbol]:
    axis = _other_axis(symbol, dim)
    whole = symbol.shape[axis]
    if isinstance(sizes, int):
        sizes = [min(sizes, whole - k) for k in range(0, whole, sizes)]
    ends = np.cumsum([0, *sizes])
    return [_slice(symbol, axis, int(a), int(b)) for a, b in pairwise(ends)]


def _expand(symbol: Symbol, size: Sequence[int], **_: Any) -> Symbol:
    if symbol.packed is not None:
        raise UntraceableError("flattened channels")
    more = len(size) - symbol.dim()
    old = (*(1,) * more, *symbol.shape)
    shape = [had if new == -1 else new for had, new in zip(old, size, strict=True)]
    time_axis = None if symbol.time_axis is None else symbol.time_axis + more
    if time_axis is None:
        # a constant is repeated for each time: the time axis is new
        grown = [
            k
            for k, (had, new) in enumerate(zip(old, shape, strict=True))
            if had != new and new in symbol.tracing.lengths
        ]
        time_axis = grown[0] if grown else None
    full = [1 if k == time_axis else new for k, new in enumerate(shape)]
    return symbol.like(
        np.broadcast_to(symbol.nodes.reshape([*(1,) * more, *symbol.nodes.shape]), full), shape, time_axis
    )


def _permute(symbol: Symbol, dims: Sequence[int]) -> Symbol:
    if symbol.packed is not None:
        raise UntraceableError("flattened channels")
    order = [_axis(k, symbol.dim()) for k in dims]
    time_axis = None if symbol.time_axis is None else order.index(symbol.time_axis)
    return symbol.like(symbol.nodes.transpose(order), [symbol.shape[k] for k in order], time_axis)


def _transpose(symbol: Symbol, first: int = 0, second: int = 1) -> Symbol:
    order = list(range(symbol.dim()))
    first, second = _axis(first, symbol.dim()), _axis(second, symbol.dim())
    order[first], order[second] = order[second], order[first]
    return _permute(symbol, order)


def _t(symbol: Symbol) -> Symbol:
    return _unchanged(symbol) if symbol.dim() < 2 else _transpose(symbol)


def _index(symbol: Symbol, indices: Sequence[Tensor | None]) -> Symbol:
    chosen = [(k, index) for k, index in enumerate(indices) if index is not None]
    if len(chosen) != 1 or isinstance(chosen[0][1], Symbol) or chosen[0][1].dim() != 1:
        raise UntraceableError("an index of several axes")
    axis = _other_axis(symbol, chosen[0][0])
    index = chosen[0][1].numpy()
    nodes = symbol.nodes[(slice(None),) * axis + (index,)]
    return symbol.like(nodes, [*symbol.shape[:axis], nodes.shape[axis], *symbol.shape[axis + 1 :]], symbol.time_axis)


def _joined(values: Sequence[Any], dim: int, join: Callable[[Sequence[Nodes], int], Nodes], new_axis: bool) -> Symbol:
    like = next(value for value in values if isinstance(value, Symbol))
    parts = [as_nodes(value, like.tracing) for value in values]
    parts = [part for part in parts if new_axis or part.shape != (0,)]
    axis = _axis(dim, len(parts[0].shape) + new_axis)
    time_axis = next((part.time_axis for part in parts if part.time_axis is not None), None)
    if not new_axis and axis == time_axis:
        raise UntraceableError("concatenation along the time axis")
    if any(part.time_axis != time_axis for part in parts):
        raise UntraceableError("arguments with and without a time axis")
    nodes = join([part.nodes for part in parts], axis)
    total = len(parts) if new_axis else sum(part.shape[axis] for part in parts)
    shape = list(parts[0].shape)
    shape[axis : axis + (not new_axis)] = [total]
    if time_axis is not None and new_axis:
        time_axis += time_axis >= axis
    return like.like(nodes, shape, time_axis)


def _stack(values: Sequence[Any], dim: int = 0) -> Symbol:
    return _joined(values, dim, lambda nodes, axis: np.stack(nodes, axis), True)


def _cat(values: Sequence[Any], dim: int = 0) -> Symbol:
    return _joined(values, dim, lambda nodes, axis: np.concatenate(nodes, axis), False)


def _added(e: Expressions, nodes: Nodes, axis: int) -> Nodes:
    rows = np.moveaxis(nodes, axis, 0)
    total = np.full(rows.shape[1:], e.number(0.0), dtype=np.int64)
    for row in rows:
        total = np.asarray(np.frompyfunc(lambda a, b: e.apply("add", int(a), int(b)), 2, 1)(total, row)).astype(
            np.int64
        )
    return total


def _sum(symbol: Symbol, dim: Sequence[int] | None = None, keepdim: bool = False, **_: Any) -> Symbol:
    dims = dim if dim else range(symbol.dim())
    axes = sorted((_other_axis(symbol, k) for k in dims), reverse=True)
    nodes, shape, time_axis = symbol.nodes, list(symbol.shape), symbol.time_axis
    for axis in axes:
        nodes = _added(symbol.expressions, nodes, axis)
        if keepdim:
            nodes, shape[axis] = np.expand_dims(nodes, axis), 1
        else:
            del shape[axis]
            time_axis = None if time_axis is None else time_axis - (time_axis > axis)
    return symbol.like(nodes, shape, time_axis)


def _product(like: Symbol, rows: Any, vector: Nodes) -> Nodes:
    """Nodes of the product of ``rows``, along the last axis, and a vector."""
    nodes = as_nodes(rows, like.tracing).nodes
    e = like.expressions
    products = np.frompyfunc(lambda x, y: e.apply("mul", int(x), int(y)), 2, 1)(nodes, vector)
    return _added(e, np.asarray(products).astype(np.int64), -1)


def _mv(matrix: Any, vector: Any) -> Symbol:
    """Multiply a matrix, which may have a row for each time, by a vector."""
    like = matrix if isinstance(matrix, Symbol) else vector
    nodes, _, time_axis = as_nodes(vector, like.tracing)
    if time_axis is not None:
        raise UntraceableError("a sum over the time axis")
    if not isinstance(matrix, Symbol) and any(
        len(matrix) % size == 0 and len(matrix) > size for size in like.tracing.lengths
    ):
        # the channels of each time, in sequence
        return Symbol(like.tracing, np.zeros(0, np.int64), (len(matrix),), None, packed=(matrix, nodes))
    own = as_nodes(matrix, like.tracing)
    if own.time_axis == 1:
        raise UntraceableError("a sum over the time axis")
    return like.like(_product(like, matrix, nodes), own.shape[:1], own.time_axis)


def _mm(left: Any, right: Any) -> Symbol:
    return _stack([_mv(left, column) for column in right.unbind(1)], 1)


def _dot(left: Any, right: Any) -> Symbol:
    return _select(_mv(left.unsqueeze(0), right), 0, 0)


SHAPES: Mapping[str, Callable[..., Any]] = {
    **dict.fromkeys(("detach", "clone", "alias", "lift_fresh", "contiguous", "positive"), _unchanged),
    **dict.fromkeys(("view", "_unsafe_view", "reshape", "_reshape_alias"), _view),
    "zeros_like": _filled(0.0),
    "ones_like": _filled(1.0),
    "full_like": _full_like,
    "new_zeros": _new(0.0),
    "new_ones": _new(1.0),
    "new_full": _new_full,
    "unsqueeze": _unsqueeze,
    "squeeze": _squeeze,
    "select": _select,
    "slice": _slice,
    "unbind": _unbind,
    "split": _split,
    "split_with_sizes": _split,
    "expand": _expand,
    "permute": _permute,
    "transpose": _transpose,
    "t": _t,
    "index": _index,
    "stack": _stack,
    "cat": _cat,
    "sum": _sum,
    "mm": _mm,
    "mv": _mv,
    "dot": _dot,
}
