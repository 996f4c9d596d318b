"""Functions outside torch in traced expressions: all their values at once, of which each is an item."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from torch import Tensor

from mkc_torch.simulation.dynamics.compiled.symbol import Symbol, UntraceableError, as_nodes
from mkc_torch.simulation.foreign.evaluation import EvaluationPoints, Group

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

    Points = tuple[EvaluationPoints, tuple[int, ...]]
    """Points as rows, and the shape of the stations or samples that they are."""


Single = Callable[[Sequence[float], Sequence[float], Sequence[float]], Sequence[float]]
"""The rates at a point, from its states, inputs and parameters."""


class ForeignFunction(Protocol):
    """Values and derivatives of a function outside torch at S points, (S, k) each; its rates at a point, if fast."""

    def count(self, outputs: bool) -> int: ...
    def values(self, outputs: bool, at: EvaluationPoints) -> Array: ...
    def slope(self, outputs: bool, at: EvaluationPoints, group: Group, number: int) -> Array: ...
    def single(self) -> Single | None: ...


@dataclass(frozen=True)
class ForeignCall:
    """A call of a function outside torch.

    Its arguments are the time, the states, the inputs and the parameters.

    Attributes:
        function: the function.
        outputs: whether it returns outputs instead of rates.
        states, inputs: their numbers.
    """

    function: ForeignFunction
    outputs: bool
    states: int
    inputs: int

    @property
    def count(self) -> int:
        """Number of values."""
        return self.function.count(self.outputs)

    def points(self, *values: Any) -> Points:
        """The points at which the function is evaluated; the parameters are numbers."""
        last = 1 + self.states + self.inputs
        shape = np.broadcast_shapes(*(np.shape(value) for value in values[:last]))

        def table(columns: Sequence[Any]) -> Array:
            found = np.empty((math.prod(shape), len(columns)))
            for k, column in enumerate(columns):
                found[:, k] = np.broadcast_to(column, shape).reshape(-1)
            return found

        states, inputs = table(values[1 : 1 + self.states]), table(values[1 + self.states : last])
        return EvaluationPoints(table(values[:1])[:, 0], states, inputs, np.array(values[last:], np.float64)), shape

    def values(self, points: Points) -> Array:
        """The values, (k, *), in the shape of the points."""
        at, shape = points
        return self.function.values(self.outputs, at).T.reshape(-1, *shape)

    def slope_by(self, argument: int) -> Callable[[Points], Array]:
        """A function that returns the derivatives by the argument of this number, (k, *)."""
        groups: tuple[tuple[Group, int], ...] = (
            ("states", 1),
            ("inputs", 1 + self.states),
            ("parameters", 1 + self.states + self.inputs),
        )
        group, first = next(each for each in reversed(groups) if argument >= each[1])

        def slope(points: Points) -> Array:
            at, shape = points
            return self.function.slope(self.outputs, at, group, argument - first).T.reshape(-1, *shape)

        return slope


def traced_call(
    function: ForeignFunction,
    outputs: bool,
    time: Tensor,
    states: Sequence[Tensor],
    inputs: Sequence[Tensor],
    parameters: Sequence[Tensor],
) -> Symbol | None:
    """The values of a function outside torch of symbols, (S, k); None where no argument is a symbol.

    Args:
        function: the function.
        outputs: return outputs instead of rates.
        time: (S,), in s.
        states, inputs: columns, (S,) each.
        parameters: a number each.

    Raises:
        UntraceableError: a parameter changes with time, or the points are at times of their own.
    """
    given = (time, *states, *inputs, *parameters)
    symbol = next((value for value in given if isinstance(value, Symbol)), None)
    if symbol is None:
        return None
    trace, last = symbol.tracing, 1 + len(states) + len(inputs)
    parts = [as_nodes(value, trace) for value in given]
    if any(part.time_axis is not None for part in parts[last:]) or len(time) not in trace.lengths:
        raise UntraceableError("a parameter that changes with time")
    if any(part.nodes.size != 1 for part in parts):
        raise UntraceableError("an argument with several channels")
    call = ForeignCall(function, outputs, len(states), len(inputs))
    nodes = trace.expressions.call(call, [int(part.nodes.reshape(-1)[0]) for part in parts])
    return Symbol(trace, np.array([nodes], dtype=np.int64), (len(time), len(nodes)), 0)
