"""Expressions in the order of their evaluation with NumPy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mkc_torch.simulation.dynamics.compiled.expressions import CONSTANT, FUNCTIONS, PARAMETER, STATE, Array, Expressions

__all__ = ["Evaluation", "Tape"]

_Step = tuple[Callable[..., Any], int, tuple[int, ...]]


class Tape:
    """Nodes of :class:`Expressions` at fixed moments, evaluated as few times as what they depend on changes.

    Warnings of NumPy, as of a division by 0, are the caller's to silence.

    Args:
        expressions: with the nodes.
        outputs: the nodes that are asked for.
        arranged: what brings a column of constants into the shape of the states.

    Example:
        >>> e = Expressions()
        >>> x, p = e.leaf("state", 0), e.leaf("parameter", 0)
        >>> tape = Tape(e, [e.apply("mul", p, x)], lambda column: column)
        >>> tape.at([3.0])(np.array([[1.0, 2.0]]))
        [array([3., 6.])]
    """

    def __init__(self, expressions: Expressions, outputs: Sequence[int], arranged: Callable[[Array], Array]) -> None:
        needed = _needed(expressions, outputs)
        place = {node: k for k, node in enumerate(needed)}
        self.outputs = [place[node] for node in outputs]
        self._fixed: list[Any] = [None] * len(needed)
        self._parameters: list[tuple[int, int]] = []
        self._states: list[tuple[int, int]] = []
        steps: tuple[list[_Step], ...] = ([], [], [])
        for node, k in place.items():
            own = expressions.nodes[node]
            if own.operation == "number":
                self._fixed[k] = own.value
            elif own.operation == "column":
                self._fixed[k] = arranged(expressions.columns[int(own.value)])
            elif own.operation == "parameter":
                self._parameters.append((k, int(own.value)))
            elif own.operation == "state":
                self._states.append((k, int(own.value)))
            else:
                arguments = tuple(place[one] for one in own.arguments)
                steps[expressions.levels[node]].append((FUNCTIONS[own.operation], k, arguments))
        with np.errstate(all="ignore"):
            _run(steps[CONSTANT], self._fixed)
        self._by_parameters, self._by_states = steps[PARAMETER], steps[STATE]

    def at(self, parameters: Sequence[float]) -> Evaluation:
        """The nodes as a function of the states, at these parameters."""
        slots = list(self._fixed)
        for k, index in self._parameters:
            slots[k] = parameters[index]
        _run(self._by_parameters, slots)

        def evaluated(states: Array) -> list[Any]:
            own = list(slots)
            for k, index in self._states:
                own[k] = states[index]
            _run(self._by_states, own)
            return [own[k] for k in self.outputs]

        return evaluated


Evaluation = Callable[[Array], list[Any]]
"""The values of nodes by the states, (w, *): arrays of the states' shape, or numbers."""


def _needed(expressions: Expressions, outputs: Sequence[int]) -> list[int]:
    """The nodes that outputs are made of, each after its arguments."""
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
        slots[k] = function(*[slots[one] for one in arguments])
