"""Evaluate expressions with NumPy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mkc_torch.simulation.dynamics.compiled.expressions import (
    CONSTANT,
    PARAMETER,
    STATE,
    Array,
    Course,
    Expressions,
)

_Step = tuple[Callable[..., Any], int, tuple[int, ...]]


class Tape:
    """Evaluates nodes at fixed stations or samples; constants once, and parameter terms once for all states.

    The caller silences warnings of NumPy, such as a division by 0.

    Args:
        expressions: the expressions that hold the nodes.
        outputs: the nodes to return.
        arranged: reshapes a column to the shape of the states.

    Example:
        >>> e = Expressions()
        >>> x, p = e.leaf("state", 0), e.leaf("parameter", 0)
        >>> tape = Tape(e, [e.apply("mul", p, x)], lambda column: column)
        >>> tape.at([3.0])(np.array([[1.0, 2.0]]))
        [array([3., 6.])]
    """

    def __init__(self, expressions: Expressions, outputs: Sequence[int], arranged: Callable[[Array], Array]) -> None:
        needed = needed_nodes(expressions, outputs)
        place = {node: k for k, node in enumerate(needed)}
        self.outputs = [place[node] for node in outputs]
        self._fixed: list[Any] = [None] * len(needed)
        self._parameters: list[tuple[int, int]] = []
        self._courses: list[tuple[int, Course]] = []
        self._states: list[tuple[int, int]] = []
        self._nodes = needed
        steps: tuple[list[_Step], ...] = ([], [], [])
        for node, k in place.items():
            own = expressions.nodes[node]
            if own.operation == "number":
                self._fixed[k] = own.value
            elif own.operation == "column":
                self._fixed[k] = arranged(expressions.columns[int(own.value)])
            elif own.operation == "course":
                self._courses.append((k, expressions.courses[int(own.value)]))
            elif own.operation == "parameter":
                self._parameters.append((k, int(own.value)))
            elif own.operation == "state":
                self._states.append((k, int(own.value)))
            else:
                arguments = tuple(place[argument] for argument in own.arguments)
                steps[expressions.levels[node]].append((expressions.function(node), k, arguments))
        with np.errstate(all="ignore"):
            _run(steps[CONSTANT], self._fixed)
        self._arranged = arranged
        self._by_parameters, self._by_states = steps[PARAMETER], steps[STATE]

    @property
    def steps(self) -> list[tuple[Callable[..., Any], int, tuple[int, ...], int]]:
        """What depends on the states, in sequence: function, place of the value, places of the arguments, node."""
        return [(function, k, arguments, self._nodes[k]) for function, k, arguments in self._by_states]

    @property
    def states(self) -> list[tuple[int, int]]:
        """Place and index of each state."""
        return self._states

    def values_at(self, parameters: Sequence[float]) -> list[Any]:
        """The values that do not depend on the states, at their places; None elsewhere."""
        slots = list(self._fixed)
        for k, index in self._parameters:
            slots[k] = parameters[index]
        for k, course in self._courses:
            slots[k] = self._arranged(course.at(parameters))
        _run(self._by_parameters, slots)
        return slots

    def at(self, parameters: Sequence[float]) -> Evaluation:
        """The output nodes as a function of the states, at these parameters."""
        slots = self.values_at(parameters)

        def evaluated(states: Array) -> list[Any]:
            own = list(slots)
            for k, index in self._states:
                own[k] = states[index]
            _run(self._by_states, own)
            return [own[k] for k in self.outputs]

        return evaluated


Evaluation = Callable[[Array], list[Any]]
"""A function from the states, (w, *), to the values of nodes: arrays of shape (*), or numbers."""


def needed_nodes(expressions: Expressions, outputs: Sequence[int]) -> list[int]:
    """The nodes that outputs depend on, each after its arguments."""
    found: set[int] = set()
    waiting = list(outputs)
    while waiting:
        node = waiting.pop()
        if node not in found:
            found.add(node)
            waiting.extend(expressions.nodes[node].arguments)
    return sorted(found)


def _run(steps: Sequence[_Step], slots: list[Any]) -> None:
    for function, k, arguments in steps:
        slots[k] = function(*[slots[argument] for argument in arguments])
