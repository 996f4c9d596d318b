"""Scalar expressions of states, parameters and columns of constants, and their derivatives."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CONSTANT, PARAMETER, STATE = 0, 1, 2
"""Level of a node: the highest kind of leaf that it depends on."""


def _sigmoid(x: Any) -> Any:
    return 1.0 / (1.0 + np.exp(-x))


def _double(x: Any) -> Any:
    return np.multiply(x, 1.0)


FUNCTIONS: dict[str, Callable[..., Any]] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "pow": np.power,
    "neg": np.negative,
    "abs": np.absolute,
    "sign": np.sign,
    "sqrt": np.sqrt,
    "exp": np.exp,
    "expm1": np.expm1,
    "log": np.log,
    "log1p": np.log1p,
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "atan2": np.arctan2,
    "sinh": np.sinh,
    "cosh": np.cosh,
    "tanh": np.tanh,
    "sigmoid": _sigmoid,
    "hypot": np.hypot,
    "maximum": np.maximum,
    "minimum": np.minimum,
    "clamp_min": np.maximum,
    "clamp_max": np.minimum,
    "relu": lambda x: np.maximum(x, 0.0),
    "floor": np.floor,
    "ceil": np.ceil,
    "trunc": np.trunc,
    "round": np.rint,
    "double": _double,
    "where": np.where,
    "gt": np.greater,
    "ge": np.greater_equal,
    "lt": np.less,
    "le": np.less_equal,
    "eq": np.equal,
    "ne": np.not_equal,
    "logical_and": np.logical_and,
    "logical_or": np.logical_or,
    "logical_not": np.logical_not,
}
"""The NumPy function of each operation."""


class ColumnsByParameters(Protocol):
    """Columns that depend on the parameters alone; see :class:`..courses.Courses`."""

    def column(self, parameters: Sequence[float], number: int, by: int | None) -> Array: ...


class Course(NamedTuple):
    """A column that depends on the parameters alone, or its derivative by a parameter.

    Attributes:
        columns: the columns, as functions of the parameters.
        number: of the column.
        by: index of the parameter; None for the column itself.
    """

    columns: ColumnsByParameters
    number: int
    by: int | None = None

    def at(self, parameters: Sequence[float]) -> Array:
        """Return the values for each station, (S,)."""
        return self.columns.column(parameters, self.number, self.by)


class Call(Protocol):
    """A function of many values at once; see :class:`..foreign.ForeignCall`."""

    @property
    def count(self) -> int: ...
    def points(self, *values: Any) -> Any: ...
    def values(self, points: Any) -> Array: ...
    def slope_by(self, argument: int) -> Callable[[Any], Array]: ...


@dataclass(frozen=True)
class Node:
    """An operation on other nodes, or a leaf with its ``value``.

    Leaves are "number", "column", "course", "parameter" and "state". A call is a node "points" of its arguments, a
    node "values" of the points, or "slope" by an argument, and an "item" of these for each value.
    """

    operation: str
    arguments: tuple[int, ...] = ()
    value: float = 0.0


class Expressions:
    """A list of nodes in which each node follows its arguments; equal nodes are stored once.

    Example:
        The derivative of ``sin(x) p`` by the state x:

        >>> e = Expressions()
        >>> x, p = e.leaf("state", 0), e.leaf("parameter", 0)
        >>> slope = e.derivative(e.apply("mul", e.apply("sin", x), p), x)
        >>> slope == e.apply("mul", p, e.apply("cos", x))
        True
    """

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self.columns: list[Array] = []
        self.courses: list[Course] = []
        self.calls: list[Call] = []
        self.levels: list[int] = []
        self._leaves: list[frozenset[int]] = []
        self._known: dict[Node, int] = {}
        self._derivatives: dict[tuple[int, int], int] = {}

    def number(self, value: float) -> int:
        """A constant."""
        return self._node(Node("number", (), float(value)))

    def column(self, values: Array) -> int:
        """A column of constants, a value for each station, (S,)."""
        self.columns.append(values)
        return self._node(Node("column", (), len(self.columns) - 1))

    def course(self, course: Course, parameters: Iterable[int]) -> int:
        """A column that depends on these parameters alone, given by their nodes."""
        self.courses.append(course)
        node = self._node(Node("course", (), len(self.courses) - 1))
        self._leaves[node] = frozenset(parameters)
        return node

    def call(self, call: Call, arguments: Sequence[int]) -> list[int]:
        """The values of a call, an item each."""
        if call not in self.calls:
            self.calls.append(call)
        points = self._node(Node("points", tuple(arguments), self.calls.index(call)))
        values = self._node(Node("values", (points,)))
        return [self._node(Node("item", (values,), k)) for k in range(call.count)]

    def slope(self, points: int, argument: int) -> int:
        """The derivatives of a call's values at its points by the argument of this number."""
        return self._node(Node("slope", (points,), argument))

    def function(self, node: int) -> Callable[..., Any]:
        """The NumPy function of a node that is no leaf."""
        own = self.nodes[node]
        if own.operation == "item":
            return itemgetter(int(own.value))
        if own.operation not in ("points", "values", "slope"):
            return FUNCTIONS[own.operation]
        points = own if own.operation == "points" else self.nodes[own.arguments[0]]
        call = self.calls[int(points.value)]
        if own.operation == "points":
            return call.points
        return call.values if own.operation == "values" else call.slope_by(int(own.value))

    def leaf(self, kind: str, index: int) -> int:
        """The parameter or state of this index; ``kind`` is "parameter" or "state"."""
        return self._node(Node(kind, (), index))

    def apply(self, operation: str, *arguments: int) -> int:
        """Apply an operation to nodes, simplified where an argument is 0 or 1."""
        simple = self._simplified(operation, arguments)
        if simple is not None:
            return simple
        values = [self._value(argument) for argument in arguments]
        if all(value is not None for value in values):
            with np.errstate(all="ignore"):
                found = FUNCTIONS[operation](*values)
            if not isinstance(found, (bool, np.bool_)):
                return self.number(float(found))
        return self._node(Node(operation, tuple(arguments)))

    def leaves(self, node: int) -> frozenset[int]:
        """The parameters and states that a node depends on."""
        return self._leaves[node]

    def derivative(self, node: int, leaf: int) -> int:
        """Differentiate a node by a parameter or state; where the derivative is not unique, as torch does.

        Raises:
            KeyError: an operation without a rule.
        """
        if node == leaf:
            return self.number(1.0)
        if leaf not in self._leaves[node]:
            return self.number(0.0)
        key = (node, leaf)
        if key not in self._derivatives:
            self._derivatives[key] = self._derived(node, leaf)
        return self._derivatives[key]

    def _derived(self, node: int, leaf: int) -> int:
        operation, arguments = self.nodes[node].operation, self.nodes[node].arguments
        if operation == "course":
            course = self.courses[int(self.nodes[node].value)]
            return self.course(course._replace(by=int(self.nodes[leaf].value)), ())
        if operation in _FLAT:
            return self.number(0.0)
        if operation == "item":
            return self._derived_item(node, leaf)
        if operation == "where":
            slopes = [self.derivative(branch, leaf) for branch in arguments[1:]]
            return slopes[0] if slopes[0] == slopes[1] else self.apply("where", arguments[0], *slopes)
        total = self.number(0.0)
        for place, argument in enumerate(arguments):
            slope = self.derivative(argument, leaf)
            if self._value(slope) != 0.0:
                total = self.apply("add", total, self.apply("mul", _RULES[operation][place](self, node), slope))
        return total

    def _derived_item(self, node: int, leaf: int) -> int:
        values = self.nodes[self.nodes[node].arguments[0]]
        if values.operation != "values":
            raise KeyError("the second derivative of a call")
        total, points = self.number(0.0), values.arguments[0]
        for place, argument in enumerate(self.nodes[points].arguments):
            slope = self.derivative(argument, leaf)
            if self._value(slope) != 0.0:
                own = self._node(Node("item", (self.slope(points, place),), self.nodes[node].value))
                total = self.apply("add", total, self.apply("mul", own, slope))
        return total

    def _node(self, node: Node) -> int:
        if node not in self._known:
            self._known[node] = index = len(self.nodes)
            self.nodes.append(node)
            own = {"parameter": PARAMETER, "course": PARAMETER, "state": STATE}.get(node.operation, CONSTANT)
            self.levels.append(max([own, *(self.levels[argument] for argument in node.arguments)]))
            leaves = frozenset((index,)) if node.operation in ("parameter", "state") else frozenset()
            self._leaves.append(leaves.union(*(self._leaves[argument] for argument in node.arguments)))
        return self._known[node]

    def _value(self, node: int) -> float | None:
        found = self.nodes[node]
        return found.value if found.operation == "number" else None

    def _simplified(self, operation: str, arguments: tuple[int, ...]) -> int | None:
        if operation not in ("add", "sub", "mul", "div", "pow"):
            return None
        first, second = arguments
        a, b = self._value(first), self._value(second)
        if operation == "add":
            return second if a == 0.0 else first if b == 0.0 else None
        if operation == "sub":
            return first if b == 0.0 else self.apply("neg", second) if a == 0.0 else None
        if operation == "mul":
            if 0.0 in (a, b):
                return self.number(0.0)
            return second if a == 1.0 else first if b == 1.0 else None
        if operation == "div":
            return self.number(0.0) if a == 0.0 and b != 0.0 else first if b == 1.0 else None
        return first if b == 1.0 else self.apply("mul", first, first) if b == 2.0 else None


_Rule = Callable[[Expressions, int], int]


def _of(build: Callable[..., int]) -> _Rule:
    """Build a rule from a function of the expressions, the node, and the node's arguments."""
    return lambda e, node: build(e, node, *e.nodes[node].arguments)


def _square(e: Expressions, node: int) -> int:
    return e.apply("mul", node, node)


def _one_minus(e: Expressions, node: int) -> int:
    return e.apply("sub", e.number(1.0), node)


def _ratio(e: Expressions, a: int, b: int) -> int:
    return e.apply("div", a, b)


def _inverse(e: Expressions, node: int) -> int:
    return _ratio(e, e.number(1.0), node)


def _negative(e: Expressions, node: int) -> int:
    return e.apply("neg", node)


def _indicator(e: Expressions, operation: str, a: int, b: int) -> int:
    """1 where a comparison holds, else 0."""
    return e.apply("double", e.apply(operation, a, b))


def _indicator_with_ties(e: Expressions, operation: str, a: int, b: int) -> int:
    """As :func:`_indicator`, plus 1/2 where both are equal."""
    half = e.apply("mul", e.number(0.5), _indicator(e, "eq", a, b))
    return e.apply("add", _indicator(e, operation, a, b), half)


def _power(e: Expressions, a: int, b: int) -> int:
    return e.apply("mul", b, e.apply("pow", a, e.apply("sub", b, e.number(1.0))))


def _logarithmic(e: Expressions, node: int, a: int) -> int:
    slope = e.apply("mul", node, e.apply("log", a))
    return e.apply("where", e.apply("gt", a, e.number(0.0)), slope, e.number(0.0))


_FLAT = {"sign", "floor", "ceil", "trunc", "round", "gt", "ge", "lt", "le", "eq", "ne"} | {
    "logical_and",
    "logical_or",
    "logical_not",
}
"""Operations whose derivative is 0 wherever it exists."""

_RULES: dict[str, tuple[_Rule, ...]] = {
    "add": (_of(lambda e, _n, _a, _b: e.number(1.0)), _of(lambda e, _n, _a, _b: e.number(1.0))),
    "sub": (_of(lambda e, _n, _a, _b: e.number(1.0)), _of(lambda e, _n, _a, _b: e.number(-1.0))),
    "mul": (_of(lambda _e, _n, _a, b: b), _of(lambda _e, _n, a, _b: a)),
    "div": (_of(lambda e, _n, _a, b: _inverse(e, b)), _of(lambda e, n, _a, b: _negative(e, _ratio(e, n, b)))),
    "pow": (_of(lambda e, _n, a, b: _power(e, a, b)), _of(lambda e, n, a, _b: _logarithmic(e, n, a))),
    "neg": (_of(lambda e, _n, _a: e.number(-1.0)),),
    "abs": (_of(lambda e, _n, a: e.apply("sign", a)),),
    "sqrt": (_of(lambda e, n, _a: _ratio(e, e.number(0.5), n)),),
    "exp": (_of(lambda _e, n, _a: n),),
    "expm1": (_of(lambda e, n, _a: e.apply("add", n, e.number(1.0))),),
    "log": (_of(lambda e, _n, a: _inverse(e, a)),),
    "log1p": (_of(lambda e, _n, a: _inverse(e, e.apply("add", a, e.number(1.0)))),),
    "sin": (_of(lambda e, _n, a: e.apply("cos", a)),),
    "cos": (_of(lambda e, _n, a: _negative(e, e.apply("sin", a))),),
    "tan": (_of(lambda e, n, _a: e.apply("add", e.number(1.0), _square(e, n))),),
    "asin": (_of(lambda e, _n, a: _inverse(e, e.apply("sqrt", _one_minus(e, _square(e, a))))),),
    "acos": (_of(lambda e, _n, a: _negative(e, _inverse(e, e.apply("sqrt", _one_minus(e, _square(e, a)))))),),
    "atan": (_of(lambda e, _n, a: _inverse(e, e.apply("add", e.number(1.0), _square(e, a)))),),
    "atan2": (
        _of(lambda e, _n, a, b: _ratio(e, b, e.apply("add", _square(e, a), _square(e, b)))),
        _of(lambda e, _n, a, b: _negative(e, _ratio(e, a, e.apply("add", _square(e, a), _square(e, b))))),
    ),
    "sinh": (_of(lambda e, _n, a: e.apply("cosh", a)),),
    "cosh": (_of(lambda e, _n, a: e.apply("sinh", a)),),
    "tanh": (_of(lambda e, n, _a: _one_minus(e, _square(e, n))),),
    "sigmoid": (_of(lambda e, n, _a: e.apply("mul", n, _one_minus(e, n))),),
    "hypot": (_of(lambda e, n, a, _b: _ratio(e, a, n)), _of(lambda e, n, _a, b: _ratio(e, b, n))),
    "maximum": (
        _of(lambda e, _n, a, b: _indicator_with_ties(e, "gt", a, b)),
        _of(lambda e, _n, a, b: _indicator_with_ties(e, "gt", b, a)),
    ),
    "minimum": (
        _of(lambda e, _n, a, b: _indicator_with_ties(e, "lt", a, b)),
        _of(lambda e, _n, a, b: _indicator_with_ties(e, "lt", b, a)),
    ),
    "clamp_min": (
        _of(lambda e, _n, a, b: _indicator(e, "ge", a, b)),
        _of(lambda e, _n, a, b: _indicator(e, "lt", a, b)),
    ),
    "clamp_max": (
        _of(lambda e, _n, a, b: _indicator(e, "le", a, b)),
        _of(lambda e, _n, a, b: _indicator(e, "gt", a, b)),
    ),
    "relu": (_of(lambda e, _n, a: _indicator(e, "gt", a, e.number(0.0))),),
    "double": (_of(lambda e, _n, _a: e.number(1.0)),),
}
"""The derivative of each operation by each of its arguments."""
