"""What torch's operations are on the expressions of a symbol."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from mkc_torch.simulation.dynamics.compiled.expressions import Expressions
from mkc_torch.simulation.dynamics.compiled.shapes import SHAPES
from mkc_torch.simulation.dynamics.compiled.symbol import Nodes, Symbol, UntraceableError, as_nodes

__all__ = ["OPERATIONS"]


def _pointwise(build: Callable[..., int], values: Sequence[Any], dtype: torch.dtype | None = None) -> Symbol:
    """An operation on each element, with torch's rules of broadcasting."""
    trace = next(one.tracing for one in values if isinstance(one, Symbol))
    parts = [as_nodes(one, trace) for one in values]
    shape = torch.broadcast_shapes(*(part.shape for part in parts))
    moments = {len(shape) - len(part.shape) + part.moments for part in parts if part.moments is not None}
    if len(moments) > 1:
        raise UntraceableError("moments against moments")
    built = np.frompyfunc(lambda *one: build(trace.expressions, *one), len(parts), 1)(*(part.nodes for part in parts))
    nodes: Nodes = np.asarray(built).astype(np.int64)
    return Symbol(trace, nodes, shape, moments.pop() if moments else None, dtype or torch.float64)


def _plain(name: str, dtype: torch.dtype | None = None) -> Callable[..., Symbol]:
    def operation(*values: Any) -> Symbol:
        return _pointwise(lambda e, *nodes: e.apply(name, *nodes), values, dtype)

    return operation


def _scaled(name: str) -> Callable[..., Symbol]:
    """Addition and subtraction, which take a factor."""

    def operation(one: Any, other: Any, *, alpha: float = 1) -> Symbol:
        def build(e: Expressions, a: int, b: int) -> int:
            return e.apply(name, a, b if alpha == 1 else e.apply("mul", e.number(alpha), b))

        return _pointwise(build, (one, other))

    return operation


def _reversed_sub(one: Any, other: Any, alpha: float = 1) -> Symbol:
    if alpha != 1:
        raise UntraceableError("rsub with a factor")
    return _pointwise(lambda e, a, b: e.apply("sub", b, a), (one, other))


def _is_truth(value: Any) -> bool:
    return isinstance(value, bool) or getattr(value, "dtype", None) == torch.bool


def _mul(one: Any, other: Any) -> Symbol:
    if _is_truth(one) and _is_truth(other):
        return _plain("logical_and", torch.bool)(one, other)
    return _plain("mul")(one, other)


def _div(one: Any, other: Any, *, rounding_mode: str | None = None) -> Symbol:
    if rounding_mode is not None:
        raise UntraceableError("division with rounding")
    return _plain("div")(one, other)


def _round(one: Any, *, decimals: int = 0) -> Symbol:
    if decimals:
        raise UntraceableError("rounding to decimals")
    return _plain("round")(one)


def _clamp(one: Any, low: Any = None, high: Any = None, **named: Any) -> Symbol:
    low, high = named.get("min", low), named.get("max", high)
    if low is not None:
        one = _plain("clamp_min")(one, low)
    return one if high is None else _plain("clamp_max")(one, high)


def _bitwise(name: str) -> Callable[..., Symbol]:
    def operation(*values: Any) -> Symbol:
        if not all(_is_truth(one) for one in values):
            raise UntraceableError("bits of numbers")
        return _plain(name, torch.bool)(*values)

    return operation


def _lerp(one: Any, other: Any, weight: Any) -> Symbol:
    return _pointwise(
        lambda e, a, b, w: e.apply("add", a, e.apply("mul", w, e.apply("sub", b, a))), (one, other, weight)
    )


def _addcmul(one: Any, a: Any, b: Any, *, value: float = 1) -> Symbol:
    return _scaled("add")(one, _mul(a, b), alpha=value)


def _simple(operation: str, *extra: float) -> Callable[..., Symbol]:
    def built(one: Any) -> Symbol:
        return _pointwise(lambda e, a: e.apply(operation, *(e.number(x) for x in extra), a), (one,))

    return built


def _squared(one: Any) -> Symbol:
    return _pointwise(lambda e, a: e.apply("mul", a, a), (one,))


def _reciprocal_root(one: Any) -> Symbol:
    return _pointwise(lambda e, a: e.apply("div", e.number(1.0), e.apply("sqrt", a)), (one,))


def _copied(one: Symbol, *, dtype: torch.dtype | None = None, **_: Any) -> Symbol:
    if dtype is None or dtype == one.dtype:
        return SHAPES["clone"](one)
    if dtype != torch.float64:
        raise UntraceableError(f"conversion to {dtype}")
    return _plain("double")(one)


def _logical_not(one: Any) -> Symbol:
    return _plain("logical_not", torch.bool)(one)


def _truth(name: str) -> Callable[..., Symbol]:
    return _plain(name, torch.bool)


_SAME = (
    *("neg", "abs", "sign", "sqrt", "exp", "expm1", "log", "log1p", "sin", "cos", "tan", "asin", "acos", "atan"),
    *("atan2", "sinh", "cosh", "tanh", "sigmoid", "hypot", "maximum", "minimum", "relu", "floor", "ceil", "trunc"),
    *("pow", "where", "clamp_min", "clamp_max"),
)
"""Operations that have the same name in torch and in :data:`..expressions.FUNCTIONS`."""

OPERATIONS: Mapping[str, Callable[..., Any]] = {
    **SHAPES,
    **{name: _plain(name) for name in _SAME},
    **{name: _truth(name) for name in ("gt", "ge", "lt", "le", "eq", "ne", "logical_and", "logical_or", "logical_not")},
    "add": _scaled("add"),
    "sub": _scaled("sub"),
    "rsub": _reversed_sub,
    "mul": _mul,
    "div": _div,
    "true_divide": _div,
    "round": _round,
    "clamp": _clamp,
    "sgn": _plain("sign"),
    "lerp": _lerp,
    "addcmul": _addcmul,
    "square": _squared,
    "reciprocal": _simple("div", 1.0),
    "rsqrt": _reciprocal_root,
    "bitwise_and": _bitwise("logical_and"),
    "bitwise_or": _bitwise("logical_or"),
    "bitwise_not": _bitwise("logical_not"),
    "_to_copy": _copied,
}
"""Torch's operations on symbols, by name."""
