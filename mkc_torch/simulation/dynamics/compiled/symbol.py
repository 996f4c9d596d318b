"""A tensor without values that records operations as scalar expressions for each time (station or sample)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mkc_torch.simulation.dynamics.compiled.courses import Courses
from mkc_torch.simulation.dynamics.compiled.expressions import Course, Expressions

Nodes = NDArray[np.int64]
"""Nodes in the shape of a tensor, with length 1 along its time axis."""


class UntraceableError(RuntimeError):
    """A function that uses values, mixes times, or has an operation without a rule."""


@dataclass(frozen=True)
class Trace:
    """The shared state of one function's symbols.

    Attributes:
        expressions: the expressions that hold their nodes.
        lengths: lengths of an axis that mark it as the time axis.
        operations: torch's operations on symbols, by name.
    """

    expressions: Expressions
    lengths: frozenset[int]
    operations: Mapping[str, Callable[..., Any]]


class Symbol(Tensor):
    """A tensor of expressions, an expression for each element; elements along the time axis share it.

    Attributes:
        tracing: the trace of the function.
        nodes: nodes of the elements.
        time_axis: the time axis; None without such an axis.
        packed: a matrix and nodes whose product is this tensor, if channels and times share an axis; else None.
    """

    tracing: Trace
    nodes: Nodes
    time_axis: int | None
    packed: tuple[Tensor, Nodes] | None

    @staticmethod
    def __new__(
        cls,
        trace: Trace,
        nodes: Nodes,
        shape: Sequence[int],
        time_axis: int | None,
        dtype: torch.dtype = torch.float64,
        packed: tuple[Tensor, Nodes] | None = None,
    ) -> Symbol:
        symbol = Tensor._make_wrapper_subclass(cls, torch.Size(shape), dtype=dtype)
        symbol.tracing, symbol.nodes, symbol.time_axis, symbol.packed = trace, nodes, time_axis, packed
        return symbol

    def __repr__(self) -> str:  # type: ignore[override]
        return f"Symbol{tuple(self.shape)}"

    def like(self, nodes: Nodes, shape: Sequence[int], time_axis: int | None) -> Symbol:
        """Another tensor of the same function."""
        return Symbol(self.tracing, nodes, shape, time_axis, self.dtype)

    @property
    def expressions(self) -> Expressions:
        return self.tracing.expressions

    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @classmethod
    def __torch_dispatch__(  # type: ignore[override]
        cls, func: Any, types: Any, args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        name = func.overloadpacket.__name__
        operation = _first_symbol(args).tracing.operations.get(name)
        if operation is None:
            raise UntraceableError(f"torch's operation {name}")
        return operation(*args, **(kwargs or {}))


def _first_symbol(values: Sequence[Any]) -> Symbol:
    """The first symbol among arguments or in a list among them."""
    for value in values:
        if isinstance(value, Symbol):
            return value
        if isinstance(value, list | tuple) and any(isinstance(part, Symbol) for part in value):
            return _first_symbol(value)
    raise UntraceableError("an argument by name")


def parameter_symbol(trace: Trace, count: int) -> Symbol:
    """The parameters, (count,)."""
    nodes = np.array([trace.expressions.leaf("parameter", k) for k in range(count)], dtype=np.int64)
    return Symbol(trace, nodes, (count,), None)


def state_symbol(trace: Trace, length: int, count: int) -> Symbol:
    """The states, (length, count)."""
    nodes = np.array([[trace.expressions.leaf("state", k) for k in range(count)]], dtype=np.int64)
    return Symbol(trace, nodes, (length, count), 0)


def course_symbol(function: Callable[[Tensor], Tensor], parameters: Symbol, length: int, count: int) -> Symbol:
    """Columns, (length, count), that a function of the parameters computes by torch, without a trace."""
    trace, courses = parameters.tracing, Courses(function)
    known = parameters.nodes.tolist()
    nodes = [trace.expressions.course(Course(courses, k), known) for k in range(count)]
    return Symbol(trace, np.array([nodes], dtype=np.int64), (length, count), 0)


class Part(NamedTuple):
    """An argument of an operation: its nodes, its shape, and its time axis."""

    nodes: Nodes
    shape: tuple[int, ...]
    time_axis: int | None


def as_nodes(value: object, trace: Trace) -> Part:
    """Convert an argument of an operation, a symbol, a number or a tensor of constants, to nodes.

    Raises:
        UntraceableError: a matrix with two time axes, a large or single-precision constant, or another type.
    """
    expressions, lengths = trace.expressions, trace.lengths
    if isinstance(value, Symbol):
        if value.packed is not None:
            raise UntraceableError("flattened channels")
        return Part(value.nodes, tuple(value.shape), value.time_axis)
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
        raise UntraceableError("a matrix with two time axes")
    if not axes:
        if array.size > _LARGEST_CONSTANT:
            raise UntraceableError("a large constant")
        flat = [expressions.number(float(element)) for element in array.reshape(-1)]
        return Part(np.array(flat, dtype=np.int64).reshape(shape), shape, None)
    by_element = np.moveaxis(array, axes[0], -1)
    if by_element.size > _LARGEST_CONSTANT * by_element.shape[-1]:
        raise UntraceableError("a large constant")
    flat = [_constant(expressions, column) for column in by_element.reshape(-1, by_element.shape[-1])]
    nodes = np.array(flat, dtype=np.int64).reshape(by_element.shape[:-1])
    return Part(np.expand_dims(nodes, axes[0]), shape, axes[0])


_LARGEST_CONSTANT = 4096
"""Elements of a constant at each time, at most."""


def _constant(expressions: Expressions, values: NDArray[Any]) -> int:
    """A column of constants, or a number where all are equal."""
    if values.dtype != np.bool_ and bool((values == values[0]).all()):
        return expressions.number(float(values[0]))
    return expressions.column(np.array(values))
