"""Traced expressions as programs of scalar operations for machine code."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mkc_torch.simulation.dynamics.compiled.expressions import STATE, Array, Expressions
from mkc_torch.simulation.dynamics.compiled.tape import Tape, needed_nodes

ProgramAt = tuple[NDArray[np.int64], Array, Array, NDArray[np.int64], int]
"""A program at given parameters, see :mod:`mkc_torch.simulation.dynamics.loops.programs`."""


class Program:
    """Nodes as a program of their operations on states; other operations run once for given parameters.

    Args:
        expressions: the expressions that hold the nodes.
        outputs: the nodes to compute.
        states: leaves of the states.
        shape: (A, L), arrangements and places; a column has L A values.
        codes: the code of each operation.

    Example:
        >>> e = Expressions()
        >>> x, p = e.leaf("state", 0), e.leaf("parameter", 0)
        >>> program = Program(e, [e.apply("mul", p, x)], [x], (1, 5), {"mul": 2})
        >>> [part.tolist() for part in program.at([3.0])[:2]]
        [[[2, 2, 1, 0, 0]], [3.0]]
    """

    def __init__(
        self,
        expressions: Expressions,
        outputs: Sequence[int],
        states: Sequence[int],
        shape: tuple[int, int],
        codes: dict[str, int],
    ) -> None:
        nodes, levels = expressions.nodes, expressions.levels
        needed = needed_nodes(expressions, outputs)
        steps = [node for node in needed if levels[node] == STATE and nodes[node].operation != "state"]
        used = {argument for node in steps for argument in nodes[node].arguments} | set(outputs)
        known = sorted(node for node in used if levels[node] != STATE)
        varies: dict[int, bool] = {}
        for node in needed_nodes(expressions, known):
            own = nodes[node]
            varies[node] = own.operation in ("column", "course") or any(varies[argument] for argument in own.arguments)
        self._tape = Tape(expressions, known, lambda column: column.reshape(shape[::-1]).T)
        self._columns = [place for place, node in enumerate(known) if varies[node]]
        self._numbers = [place for place, node in enumerate(known) if not varies[node]]
        order = [
            *states,
            *(known[place] for place in self._columns),
            *(known[place] for place in self._numbers),
            *steps,
        ]
        row = {node: place for place, node in enumerate(order)}
        self._code = np.zeros((len(steps), 5), dtype=np.int64)
        for place, node in enumerate(steps):
            arguments = [row[argument] for argument in nodes[node].arguments]
            self._code[place, : 2 + len(arguments)] = [codes[nodes[node].operation], row[node], *arguments]
        self._outputs = np.array([row[node] for node in outputs], dtype=np.int64)
        self._size = len(order)
        self._shape = shape

    def at(self, parameters: Sequence[float]) -> ProgramAt:
        """Return the program at these parameters. The caller silences warnings of NumPy."""
        values = self._tape.at(parameters)(_NO_STATES)
        numbers = np.array([values[place] for place in self._numbers], dtype=float)
        columns = np.empty((len(self._columns), *self._shape))
        for k, place in enumerate(self._columns):
            columns[k] = values[place]
        return self._code, numbers, columns, self._outputs, self._size


_NO_STATES = np.empty(0)
