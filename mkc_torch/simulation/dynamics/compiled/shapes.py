"""What torch's operations on shapes, and its sums and products of a few channels, are on a symbol's expressions."""

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

__all__ = ["SHAPES"]


def _axis(dim: int, count: int) -> int:
    return dim + count if dim < 0 else dim


def _free(one: Symbol, dim: int) -> int:
    """An axis that is not that of the moments."""
    axis = _axis(dim, one.dim())
    if axis == one.moments or one.packed is not None:
        raise UntraceableError("an operation along the moments")
    return axis


def _same(one: Symbol, *_: Any, **__: Any) -> Symbol:
    """The same values; torch wants another tensor."""
    return Symbol(one.tracing, one.nodes, one.shape, one.moments, one.dtype, one.packed)


def _filled(value: float) -> Callable[..., Any]:
    def like(one: Symbol, **_: Any) -> Symbol:
        if one.packed is not None:
            raise UntraceableError("flattened channels")
        nodes = np.full(one.nodes.shape, one.expressions.number(value), dtype=np.int64)
        return Symbol(one.tracing, nodes, tuple(one.shape), one.moments)

    return like


def _full_like(one: Symbol, value: float, **_: Any) -> Any:
    return _filled(float(value))(one)


def _new(value: float) -> Callable[..., Tensor]:
    def made(_: Symbol, size: Sequence[int], **named: Any) -> Tensor:
        return torch.full(tuple(size), value, dtype=named.get("dtype") or torch.float64)

    return made


def _new_full(_: Symbol, size: Sequence[int], value: float, **named: Any) -> Tensor:
    return torch.full(tuple(size), value, dtype=named.get("dtype") or torch.float64)


def _view(one: Symbol, size: Sequence[int]) -> Symbol:
    shape = list(size)
    if -1 in shape:
        shape[shape.index(-1)] = one.numel() // max(1, -math.prod(shape))
    if one.packed is not None:
        if len(shape) != 2 or shape[0] not in one.tracing.lengths:
            raise UntraceableError("flattened channels")
        matrix, nodes = one.packed
        product = _product(one, matrix.unflatten(0, shape), nodes)
        return one.like(product, shape, 0)
    if one.moments is None:
        return one.like(one.nodes.reshape(shape), shape, None)
    before, length = math.prod(one.shape[: one.moments]), one.shape[one.moments]
    places = [k for k, size in enumerate(shape) if size == length and math.prod(shape[:k]) == before]
    if not places:
        raise UntraceableError("a view that mixes the moments")
    nodes = one.nodes.reshape([1 if k == places[0] else size for k, size in enumerate(shape)])
    return one.like(nodes, shape, places[0])


def _unsqueeze(one: Symbol, dim: int) -> Symbol:
    if one.packed is not None:
        raise UntraceableError("flattened channels")
    axis = _axis(dim, one.dim() + 1)
    moments = None if one.moments is None else one.moments + (one.moments >= axis)
    shape = [*one.shape[:axis], 1, *one.shape[axis:]]
    return one.like(np.expand_dims(one.nodes, axis), shape, moments)


def _squeeze(one: Symbol, dim: int | Sequence[int] | None = None) -> Symbol:
    if dim is None:
        dims = list(range(one.dim()))
    else:
        dims = [_axis(k, one.dim()) for k in ((dim,) if isinstance(dim, int) else dim)]
    gone = tuple(k for k in dims if one.shape[k] == 1 and k != one.moments)
    moments = None if one.moments is None else one.moments - sum(k < one.moments for k in gone)
    return one.like(one.nodes.squeeze(gone), [n for k, n in enumerate(one.shape) if k not in gone], moments)


def _select(one: Symbol, dim: int, index: int) -> Symbol:
    axis = _free(one, dim)
    moments = None if one.moments is None else one.moments - (one.moments > axis)
    shape = [*one.shape[:axis], *one.shape[axis + 1 :]]
    return one.like(np.asarray(one.nodes.take(index, axis)), shape, moments)


def _slice(one: Symbol, dim: int = 0, start: int | None = None, end: int | None = None, step: int = 1) -> Symbol:
    axis = _axis(dim, one.dim())
    kept = range(one.shape[axis])[slice(start, end, step)]
    if len(kept) == one.shape[axis] and step == 1:
        return _same(one)
    axis = _free(one, axis)
    nodes = one.nodes[(slice(None),) * axis + (slice(start, end, step),)]
    shape = [*one.shape[:axis], len(kept), *one.shape[axis + 1 :]]
    return one.like(nodes, shape, one.moments)


def _unbind(one: Symbol, dim: int = 0) -> list[Symbol]:
    axis = _free(one, dim)
    return [_select(one, axis, k) for k in range(one.shape[axis])]


def _split(one: Symbol, sizes: int | Sequence[int], dim: int = 0) -> list[Symbol]:
    axis = _free(one, dim)
    whole = one.shape[axis]
    if isinstance(sizes, int):
        sizes = [min(sizes, whole - k) for k in range(0, whole, sizes)]
    ends = np.cumsum([0, *sizes])
    return [_slice(one, axis, int(a), int(b)) for a, b in pairwise(ends)]


def _expand(one: Symbol, size: Sequence[int], **_: Any) -> Symbol:
    if one.packed is not None:
        raise UntraceableError("flattened channels")
    more = len(size) - one.dim()
    old = (*(1,) * more, *one.shape)
    shape = [had if new == -1 else new for had, new in zip(old, size, strict=True)]
    moments = None if one.moments is None else one.moments + more
    if moments is None:
        # a number for each moment: the axis of moments is new
        grown = [
            k for k, (had, new) in enumerate(zip(old, shape, strict=True)) if had != new and new in one.tracing.lengths
        ]
        moments = grown[0] if grown else None
    full = [1 if k == moments else new for k, new in enumerate(shape)]
    return one.like(np.broadcast_to(one.nodes.reshape([*(1,) * more, *one.nodes.shape]), full), shape, moments)


def _permute(one: Symbol, dims: Sequence[int]) -> Symbol:
    if one.packed is not None:
        raise UntraceableError("flattened channels")
    order = [_axis(k, one.dim()) for k in dims]
    moments = None if one.moments is None else order.index(one.moments)
    return one.like(one.nodes.transpose(order), [one.shape[k] for k in order], moments)


def _transpose(one: Symbol, first: int = 0, second: int = 1) -> Symbol:
    order = list(range(one.dim()))
    first, second = _axis(first, one.dim()), _axis(second, one.dim())
    order[first], order[second] = order[second], order[first]
    return _permute(one, order)


def _t(one: Symbol) -> Symbol:
    return _same(one) if one.dim() < 2 else _transpose(one)


def _index(one: Symbol, indices: Sequence[Tensor | None]) -> Symbol:
    chosen = [(k, index) for k, index in enumerate(indices) if index is not None]
    if len(chosen) != 1 or isinstance(chosen[0][1], Symbol) or chosen[0][1].dim() != 1:
        raise UntraceableError("an index of several axes")
    axis = _free(one, chosen[0][0])
    index = chosen[0][1].numpy()
    nodes = one.nodes[(slice(None),) * axis + (index,)]
    return one.like(nodes, [*one.shape[:axis], nodes.shape[axis], *one.shape[axis + 1 :]], one.moments)


def _joined(values: Sequence[Any], dim: int, join: Callable[[Sequence[Nodes], int], Nodes], new_axis: bool) -> Symbol:
    like = next(one for one in values if isinstance(one, Symbol))
    parts = [as_nodes(one, like.tracing) for one in values]
    parts = [part for part in parts if new_axis or part.shape != (0,)]
    axis = _axis(dim, len(parts[0].shape) + new_axis)
    moments = next((part.moments for part in parts if part.moments is not None), None)
    if not new_axis and axis == moments:
        raise UntraceableError("moments after moments")
    if any(part.moments != moments for part in parts):
        raise UntraceableError("moments beside other numbers")
    nodes = join([part.nodes for part in parts], axis)
    total = len(parts) if new_axis else sum(part.shape[axis] for part in parts)
    shape = list(parts[0].shape)
    shape[axis : axis + (not new_axis)] = [total]
    if moments is not None and new_axis:
        moments += moments >= axis
    return like.like(nodes, shape, moments)


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


def _sum(one: Symbol, dim: Sequence[int] | None = None, keepdim: bool = False, **_: Any) -> Symbol:
    dims = dim if dim else range(one.dim())
    axes = sorted((_free(one, k) for k in dims), reverse=True)
    nodes, shape, moments = one.nodes, list(one.shape), one.moments
    for axis in axes:
        nodes = _added(one.expressions, nodes, axis)
        if keepdim:
            nodes, shape[axis] = np.expand_dims(nodes, axis), 1
        else:
            del shape[axis]
            moments = None if moments is None else moments - (moments > axis)
    return one.like(nodes, shape, moments)


def _product(like: Symbol, one: Any, other: Nodes) -> Nodes:
    """Nodes of the last axis of ``one`` times those of a vector."""
    nodes = as_nodes(one, like.tracing).nodes
    e = like.expressions
    products = np.frompyfunc(lambda x, y: e.apply("mul", int(x), int(y)), 2, 1)(nodes, other)
    return _added(e, np.asarray(products).astype(np.int64), -1)


def _mv(one: Any, other: Any) -> Symbol:
    """A matrix, which may have a row for each moment, times a vector."""
    like = one if isinstance(one, Symbol) else other
    nodes, _, moments = as_nodes(other, like.tracing)
    if moments is not None:
        raise UntraceableError("a sum over the moments")
    if not isinstance(one, Symbol) and any(len(one) % size == 0 and len(one) > size for size in like.tracing.lengths):
        # channels of each moment, one after the other
        return Symbol(like.tracing, np.zeros(0, np.int64), (len(one),), None, packed=(one, nodes))
    own = as_nodes(one, like.tracing)
    if own.moments == 1:
        raise UntraceableError("a sum over the moments")
    return like.like(_product(like, one, nodes), own.shape[:1], own.moments)


def _mm(one: Any, other: Any) -> Symbol:
    return _stack([_mv(one, column) for column in other.unbind(1)], 1)


def _dot(one: Any, other: Any) -> Symbol:
    return _select(_mv(one.unsqueeze(0), other), 0, 0)


SHAPES: Mapping[str, Callable[..., Any]] = {
    **dict.fromkeys(("detach", "clone", "alias", "lift_fresh", "contiguous", "positive"), _same),
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
