"""A tensor without values that notes what is computed with it, as scalar expressions for each moment."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mkc_torch.simulation.dynamics.compiled.expressions import Expressions

__all__ = ["Nodes", "Part", "Symbol", "Trace", "UntraceableError", "as_nodes", "parameter_symbol", "state_symbol"]

Nodes = NDArray[np.int64]
"""Nodes of expressions, in the shape of a tensor whose axis of moments has length 1."""


class UntraceableError(RuntimeError):
    """A function that asks for values, mixes moments, or has an operation without a rule."""


@dataclass(frozen=True)
class Trace:
    """What the symbols of one function have in common.

    Attributes:
        expressions: that hold their nodes.
        lengths: of the axes that count as moments.
        operations: torch's operations on symbols, by name.
    """

    expressions: Expressions
    lengths: frozenset[int]
    operations: Mapping[str, Callable[..., Any]]


class Symbol(Tensor):
    """A tensor as expressions: one for each of its elements, save along the axis of moments, where all have the same.

    Attributes:
        tracing: of the function.
        nodes: of the elements.
        moments: the axis of moments; None where there is none.
        packed: a matrix and nodes whose product this is, where channels and moments are one axis; None elsewhere.
    """

    tracing: Trace
    nodes: Nodes
    moments: int | None
    packed: tuple[Tensor, Nodes] | None

    @staticmethod
    def __new__(
        cls,
        trace: Trace,
        nodes: Nodes,
        shape: Sequence[int],
        moments: int | None,
        dtype: torch.dtype = torch.float64,
        packed: tuple[Tensor, Nodes] | None = None,
    ) -> Symbol:
        symbol = Tensor._make_wrapper_subclass(cls, torch.Size(shape), dtype=dtype)
        symbol.tracing, symbol.nodes, symbol.moments, symbol.packed = trace, nodes, moments, packed
        return symbol

    def __repr__(self) -> str:  # type: ignore[override]
        return f"Symbol{tuple(self.shape)}"

    def like(self, nodes: Nodes, shape: Sequence[int], moments: int | None) -> Symbol:
        """Another tensor of the same function."""
        return Symbol(self.tracing, nodes, shape, moments, self.dtype)

    @property
    def expressions(self) -> Expressions:
        return self.tracing.expressions

    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @classmethod
    def __torch_dispatch__(  # type: ignore[override]
        cls, func: Any, types: Any, args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        name = func.overloadpacket.__name__
        operation = _first(args).tracing.operations.get(name)
        if operation is None:
            raise UntraceableError(f"torch's operation {name}")
        return operation(*args, **(kwargs or {}))


def _first(values: Sequence[Any]) -> Symbol:
    """The first symbol among arguments, or in a list of them."""
    for one in values:
        if isinstance(one, Symbol):
            return one
        if isinstance(one, list | tuple) and any(isinstance(part, Symbol) for part in one):
            return _first(one)
    raise UntraceableError("an argument by name")


def parameter_symbol(trace: Trace, count: int) -> Symbol:
    """The parameters, (count,)."""
    nodes = np.array([trace.expressions.leaf("parameter", k) for k in range(count)], dtype=np.int64)
    return Symbol(trace, nodes, (count,), None)


def state_symbol(trace: Trace, length: int, count: int) -> Symbol:
    """The states, (length, count)."""
    nodes = np.array([[trace.expressions.leaf("state", k) for k in range(count)]], dtype=np.int64)
    return Symbol(trace, nodes, (length, count), 0)


class Part(NamedTuple):
    """An argument of an operation: nodes in a tensor's shape, and its axis of moments."""

    nodes: Nodes
    shape: tuple[int, ...]
    moments: int | None


def as_nodes(value: object, trace: Trace) -> Part:
    """What stands in an operation: a symbol, a number, or a tensor of constants.

    Raises:
        UntraceableError: a matrix over the moments, a large constant, one in single precision, or something else.
    """
    expressions, lengths = trace.expressions, trace.lengths
    if isinstance(value, Symbol):
        if value.packed is not None:
            raise UntraceableError("flattened channels")
        return Part(value.nodes, tuple(value.shape), value.moments)
    if isinstance(value, bool | int | float):
        return Part(np.array(expressions.number(value)), (), None)
    if not isinstance(value, Tensor):
        raise UntraceableError(f"a {type(value).__name__}")
    if value.is_complex() or (value.is_floating_point() and value.dtype != torch.float64 and value.dim() > 0):
        raise UntraceableError(f"a constant of dtype {value.dtype}")
    shape = tuple(value.shape)
    array = value.detach().numpy()
    if value.dtype != torch.bool:
        array = array.astype(np.float64)
    axes = [axis for axis, size in enumerate(shape) if size in lengths]
    if len(axes) > 1:
        raise UntraceableError("a matrix over the moments")
    if not axes:
        if array.size > _MOST:
            raise UntraceableError("a large constant")
        flat = [expressions.number(float(one)) for one in array.reshape(-1)]
        return Part(np.array(flat, dtype=np.int64).reshape(shape), shape, None)
    by_element = np.moveaxis(array, axes[0], -1)
    if by_element.size > _MOST * by_element.shape[-1]:
        raise UntraceableError("a large constant")
    flat = [_constant(expressions, one) for one in by_element.reshape(-1, by_element.shape[-1])]
    nodes = np.array(flat, dtype=np.int64).reshape(by_element.shape[:-1])
    return Part(np.expand_dims(nodes, axes[0]), shape, axes[0])


_MOST = 4096
"""Elements of a constant at most, for each moment."""


def _constant(expressions: Expressions, values: NDArray[Any]) -> int:
    """A column, or a number where all of it is the same."""
    if values.dtype != np.bool_ and bool((values == values[0]).all()):
        return expressions.number(float(values[0]))
    return expressions.column(np.array(values))
