"""Torch's operations on symbols, as operations on their expressions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from mkc_torch.simulation.dynamics.compiled.expressions import Expressions
from mkc_torch.simulation.dynamics.compiled.shapes import SHAPES
from mkc_torch.simulation.dynamics.compiled.symbol import Nodes, Symbol, UntraceableError, as_nodes


def _pointwise(build: Callable[..., int], values: Sequence[Any], dtype: torch.dtype | None = None) -> Symbol:
    """Apply an operation to each element, with torch's broadcasting."""
    trace = next(value.tracing for value in values if isinstance(value, Symbol))
    parts = [as_nodes(value, trace) for value in values]
    shape = torch.Size(np.broadcast_shapes(*(part.shape for part in parts)))  # torch's own would import sympy
    time_axes = {len(shape) - len(part.shape) + part.time_axis for part in parts if part.time_axis is not None}
    if len(time_axes) > 1:
        raise UntraceableError("two different time axes")
    built = np.frompyfunc(lambda *arguments: build(trace.expressions, *arguments), len(parts), 1)(
        *(part.nodes for part in parts)
    )
    nodes: Nodes = np.asarray(built).astype(np.int64)
    return Symbol(trace, nodes, shape, time_axes.pop() if time_axes else None, dtype or torch.float64)


def _operation(name: str, dtype: torch.dtype | None = None) -> Callable[..., Symbol]:
    def operation(*values: Any) -> Symbol:
        return _pointwise(lambda e, *nodes: e.apply(name, *nodes), values, dtype)

    return operation


def _scaled(name: str) -> Callable[..., Symbol]:
    """Addition or subtraction, which take a factor ``alpha``."""

    def operation(first: Any, second: Any, *, alpha: float = 1) -> Symbol:
        def build(e: Expressions, a: int, b: int) -> int:
            return e.apply(name, a, b if alpha == 1 else e.apply("mul", e.number(alpha), b))

        return _pointwise(build, (first, second))

    return operation


def _reversed_sub(first: Any, second: Any, alpha: float = 1) -> Symbol:
    if alpha != 1:
        raise UntraceableError("rsub with a factor")
    return _pointwise(lambda e, a, b: e.apply("sub", b, a), (first, second))


def _is_boolean(value: Any) -> bool:
    return isinstance(value, bool) or getattr(value, "dtype", None) == torch.bool


def _mul(first: Any, second: Any) -> Symbol:
    if _is_boolean(first) and _is_boolean(second):
        return _operation("logical_and", torch.bool)(first, second)
    return _operation("mul")(first, second)


def _div(first: Any, second: Any, *, rounding_mode: str | None = None) -> Symbol:
    if rounding_mode is not None:
        raise UntraceableError("division with rounding")
    return _operation("div")(first, second)


def _round(values: Any, *, decimals: int = 0) -> Symbol:
    if decimals:
        raise UntraceableError("rounding to decimals")
    return _operation("round")(values)


def _clamp(values: Any, low: Any = None, high: Any = None, **named: Any) -> Symbol:
    low, high = named.get("min", low), named.get("max", high)
    if low is not None:
        values = _operation("clamp_min")(values, low)
    return values if high is None else _operation("clamp_max")(values, high)


def _bitwise(name: str) -> Callable[..., Symbol]:
    def operation(*values: Any) -> Symbol:
        if not all(_is_boolean(value) for value in values):
            raise UntraceableError("bits of numbers")
        return _operation(name, torch.bool)(*values)

    return operation


def _lerp(start: Any, end: Any, weight: Any) -> Symbol:
    return _pointwise(
        lambda e, a, b, w: e.apply("add", a, e.apply("mul", w, e.apply("sub", b, a))), (start, end, weight)
    )


def _addcmul(first: Any, a: Any, b: Any, *, value: float = 1) -> Symbol:
    return _scaled("add")(first, _mul(a, b), alpha=value)


def _unary(operation: str, *extra: float) -> Callable[..., Symbol]:
    def built(values: Any) -> Symbol:
        return _pointwise(lambda e, a: e.apply(operation, *(e.number(x) for x in extra), a), (values,))

    return built


def _squared(values: Any) -> Symbol:
    return _pointwise(lambda e, a: e.apply("mul", a, a), (values,))


def _reciprocal_root(values: Any) -> Symbol:
    return _pointwise(lambda e, a: e.apply("div", e.number(1.0), e.apply("sqrt", a)), (values,))


def _copied(values: Symbol, *, dtype: torch.dtype | None = None, **_: Any) -> Symbol:
    if dtype is None or dtype == values.dtype:
        return SHAPES["clone"](values)
    if dtype != torch.float64:
        raise UntraceableError(f"conversion to {dtype}")
    return _operation("double")(values)


_SAME = (
    *("neg", "abs", "sign", "sqrt", "exp", "expm1", "log", "log1p", "sin", "cos", "tan", "asin", "acos", "atan"),
    *("atan2", "sinh", "cosh", "tanh", "sigmoid", "hypot", "maximum", "minimum", "relu", "floor", "ceil", "trunc"),
    *("pow", "where", "clamp_min", "clamp_max"),
)
"""Operations with the same name in torch and in :data:`..expressions.FUNCTIONS`."""

OPERATIONS: Mapping[str, Callable[..., Any]] = {
    **SHAPES,
    **{name: _operation(name) for name in _SAME},
    **{
        name: _operation(name, torch.bool)
        for name in ("gt", "ge", "lt", "le", "eq", "ne", "logical_and", "logical_or", "logical_not")
    },
    "add": _scaled("add"),
    "sub": _scaled("sub"),
    "rsub": _reversed_sub,
    "mul": _mul,
    "div": _div,
    "true_divide": _div,
    "round": _round,
    "clamp": _clamp,
    "sgn": _operation("sign"),
    "lerp": _lerp,
    "addcmul": _addcmul,
    "square": _squared,
    "reciprocal": _unary("div", 1.0),
    "rsqrt": _reciprocal_root,
    "bitwise_and": _bitwise("logical_and"),
    "bitwise_or": _bitwise("logical_or"),
    "bitwise_not": _bitwise("logical_not"),
    "_to_copy": _copied,
}
"""Torch's operations on symbols, by name."""
