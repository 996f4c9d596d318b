"""Programs of scalar operations, run over blocks of stations by machine code.

A program is a tuple:

- code: (n, 5), for each operation its code in :data:`CODES`, the row of its result, and the rows of its arguments;
- numbers: values of the rows after the states and the columns;
- columns: (c, A, L), constants at each of L places in each of A arrangements; the rows after the states;
- outputs: the rows of the results;
- size: number of rows.

The rows of the states come first. Comparisons give 1 and 0.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np
from numba.extending import register_jitable

F = TypeVar("F", bound=Callable[..., Any])

jitable = cast(Callable[[F], F], register_jitable)
"""Marks a function that loops in machine code may call; it remains a function of Python."""

BLOCK = 128
"""Places in a block: the rows of a program fit into the processor's cache."""

_ADD, _SUB, _MUL, _DIV, _NEG, _ABS, _SIGN, _SQRT, _EXP, _EXPM1, _LOG, _LOG1P, _SIN, _COS, _TAN = range(15)
_ASIN, _ACOS, _ATAN, _SINH, _COSH, _TANH, _SIGMOID, _RELU, _FLOOR, _CEIL, _TRUNC, _ROUND, _NOT, _DOUBLE = range(15, 29)
_WHERE, _GT, _GE, _LT, _LE, _EQ, _NE, _AND, _OR, _MAXIMUM, _MINIMUM, _POW, _ATAN2, _HYPOT = range(29, 43)
_FIRST_OF_TWO = _WHERE

CODES = {
    "add": _ADD, "sub": _SUB, "mul": _MUL, "div": _DIV, "pow": _POW, "neg": _NEG, "abs": _ABS, "sign": _SIGN,
    "sqrt": _SQRT, "exp": _EXP, "expm1": _EXPM1, "log": _LOG, "log1p": _LOG1P, "sin": _SIN, "cos": _COS, "tan": _TAN,
    "asin": _ASIN, "acos": _ACOS, "atan": _ATAN, "atan2": _ATAN2, "sinh": _SINH, "cosh": _COSH, "tanh": _TANH,
    "sigmoid": _SIGMOID, "hypot": _HYPOT, "maximum": _MAXIMUM, "minimum": _MINIMUM, "clamp_min": _MAXIMUM,
    "clamp_max": _MINIMUM, "relu": _RELU, "floor": _FLOOR, "ceil": _CEIL, "trunc": _TRUNC, "round": _ROUND,
    "double": _DOUBLE, "where": _WHERE, "gt": _GT, "ge": _GE, "lt": _LT, "le": _LE, "eq": _EQ, "ne": _NE,
    "logical_and": _AND, "logical_or": _OR, "logical_not": _NOT,
}  # fmt: skip
"""The code of each operation of :data:`mkc_torch.simulation.dynamics.compiled.expressions.FUNCTIONS`."""


@jitable
def registers(program: Any, states: int) -> Any:
    """Allocate the rows of a program, with its numbers."""
    _, numbers, columns, _, size = program
    rows = np.empty((size, BLOCK))
    first = states + len(columns)
    for i in range(len(numbers)):
        for k in range(BLOCK):
            rows[first + i, k] = numbers[i]
    return rows


@jitable
def loaded(program: Any, rows: Any, states: Any, place: int, arrangement: int, first: int, count: int) -> None:
    """Fill the rows of the states, from ``place`` on, and of the columns, from ``first`` on."""
    columns = program[2]
    w = len(states)
    for j in range(w):
        for k in range(count):
            rows[j, k] = states[j, place + k]
    for j in range(len(columns)):
        for k in range(count):
            rows[w + j, k] = columns[j, arrangement, first + k]


@jitable
def run(program: Any, rows: Any, count: int) -> None:
    """Run a program on the first ``count`` places of its rows."""
    code = program[0]
    for i in range(len(code)):
        op, t, a, b, c = code[i, 0], code[i, 1], code[i, 2], code[i, 3], code[i, 4]
        # only frequent operations have their own loop, because each loop takes time to compile
        if op == _ADD:
            for k in range(count):
                rows[t, k] = rows[a, k] + rows[b, k]
        elif op == _SUB:
            for k in range(count):
                rows[t, k] = rows[a, k] - rows[b, k]
        elif op == _MUL:
            for k in range(count):
                rows[t, k] = rows[a, k] * rows[b, k]
        elif op == _DIV:
            for k in range(count):
                rows[t, k] = rows[a, k] / rows[b, k]
        elif op >= _FIRST_OF_TWO:
            for k in range(count):
                rows[t, k] = _of_two(op, rows[a, k], rows[b, k], rows[c, k])
        else:
            for k in range(count):
                rows[t, k] = _of_one(op, rows[a, k])


@jitable
def _of_one(op: int, x: float) -> float:
    """The result of an operation on a number."""
    if op == _NEG:
        return -x
    if op == _ABS:
        return abs(x)
    if op == _SIGN:
        return 1.0 if x > 0.0 else -1.0 if x < 0.0 else x if x != x else 0.0
    if op == _SQRT:
        return np.sqrt(x)
    if op == _EXP:
        return np.exp(x)
    if op == _EXPM1:
        return np.expm1(x)
    if op == _LOG:
        return np.log(x)
    if op == _LOG1P:
        return np.log1p(x)
    if op == _SIN:
        return np.sin(x)
    if op == _COS:
        return np.cos(x)
    if op == _TAN:
        return np.tan(x)
    if op == _ASIN:
        return np.arcsin(x)
    if op == _ACOS:
        return np.arccos(x)
    if op == _ATAN:
        return np.arctan(x)
    if op == _SINH:
        return np.sinh(x)
    if op == _COSH:
        return np.cosh(x)
    if op == _TANH:
        return np.tanh(x)
    if op == _SIGMOID:
        return 1.0 / (1.0 + np.exp(-x))
    if op == _RELU:
        return x if x >= 0.0 or x != x else 0.0
    if op == _FLOOR:
        return np.floor(x)
    if op == _CEIL:
        return np.ceil(x)
    if op == _TRUNC:
        return np.trunc(x)
    if op == _ROUND:
        return np.rint(x)
    if op == _NOT:
        return 1.0 if x == 0.0 else 0.0
    return x


@jitable
def _of_two(op: int, x: float, y: float, z: float) -> float:
    """The result of an operation on two numbers or three."""
    if op == _WHERE:
        return y if x != 0.0 else z
    if op == _GT:
        return 1.0 if x > y else 0.0
    if op == _GE:
        return 1.0 if x >= y else 0.0
    if op == _LT:
        return 1.0 if x < y else 0.0
    if op == _LE:
        return 1.0 if x <= y else 0.0
    if op == _EQ:
        return 1.0 if x == y else 0.0
    if op == _NE:
        return 1.0 if x != y else 0.0
    if op == _AND:
        return 1.0 if x != 0.0 and y != 0.0 else 0.0
    if op == _OR:
        return 1.0 if x != 0.0 or y != 0.0 else 0.0
    if op == _MAXIMUM:
        return x if x >= y or x != x else y
    if op == _MINIMUM:
        return x if x <= y or x != x else y
    if op == _POW:
        return x**y
    if op == _ATAN2:
        return np.arctan2(x, y)
    return np.hypot(x, y)
